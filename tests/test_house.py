"""The house rules: which way imports point, and what a public name says."""

import ast
import functools
import importlib
import inspect
import pathlib
import re
import subprocess
import sys

import pytest

import jaxfx


TESTS = pathlib.Path(__file__).parent
ROOT = pathlib.Path(jaxfx.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}

# The floors, low to high. A module may import its own floor and those below it; an effect may
# not import another effect; only the topmost floor may import the host side.
NUMERICS = {
    *(
        "_arrays",
        "_checks",
        "_choice",
        "_environment",
        "_extras",
        "_filter",
        "_harmonics",
        "_holes",
        "_linear",
        "_numerics",
    ),
    "_platform",
    "_xla",
    *("_loops", "_meshes", "_progress", "_pyramid", "_sampling", "_tiles"),
}
TYPES = {"_arguments", "camera", "depth", "gbuffer", "lens", "light", "sharding", "transfer"}
EFFECTS = {"blur", "dof", "reproject", "shadow", "relight"}
HOST = {"_files", "scene", "exr", "io"}
TOP = {"fit", "metrics", "tradeoff", "budget"}

MAY_IMPORT = (
    {name: NUMERICS for name in NUMERICS}
    | {name: NUMERICS | TYPES for name in TYPES}
    | {name: NUMERICS | TYPES | {name} for name in EFFECTS}
    | {name: NUMERICS | TYPES | HOST for name in HOST}
    | {name: NUMERICS | TYPES | EFFECTS | HOST | TOP for name in TOP}
    | {"__init__": NUMERICS | TYPES | EFFECTS | TOP}
)

# What only the host side and the charts need is not loaded with `jaxfx`.
LAZY_LIBRARIES = {"embreex", "matplotlib", "OpenEXR", "OpenGL", "PIL", "pyrender", "trimesh"}

# What may be given by position, in the order in which it is given.
DATA = (
    *("render", "taps", "tap_weights"),
    *("image", "images", "shadow_map", "gbuffer", "gbuffers"),
    *("transfer", "depth", "depths"),
    *("camera", "cameras", "receivers", "lens", "source", "sources", "target"),
    *("origin", "direction", "light", "lights", "light_camera", "visibility", "views"),
)

ARRAY = re.compile(r"\b(Float|Int|Bool|Num|Shaped)\[|ArrayLike|\bAny\b|\bArray\b")
SHAPE_OR_UNIT = re.compile(
    r"height|width|channel|shape|scalar|\.\.\.|\d ?x ?\d|\b[234]\b|as in `"
    r"|pixel|unit|radian|linear|irradiance|intensity|radiance|in \[|\blengths?\b|ratio|decibel"
    r"|\bind(ex|ices)\b|integer"
)


def _part(path):
    """The module or package directly below `jaxfx` that a file belongs to."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def _imports(tree):
    """Every module of this package that a file imports, wherever in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            dots = "." * node.level
            names = [f"{dots}{node.module or ''}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.startswith("."):
                yield name
            elif name == "jaxfx" or name.startswith("jaxfx."):
                yield (*name.split("."), "jaxfx")[1]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path):
    assert _part(path) in MAY_IMPORT, f"put `{_part(path)}` on a floor, above"
    assert set(_imports(TREES[path])) <= MAY_IMPORT[_part(path)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_package_takes_what_another_keeps_to_itself(path):
    """A module or name with an underscore belongs to the package that it is in."""
    own = ("jaxfx", _part(path))
    for node in ast.walk(TREES[path]):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("jaxfx."):
            continue
        package = tuple(node.module.split(".")[:2])
        names = [*node.module.split(".")[2:], *(alias.name for alias in node.names)]
        private = [name for name in names if name.startswith("_")]
        assert package == own or not private, f"{node.module}: {private}"


def test_host_side_is_loaded_when_it_is_asked_for():
    loaded = f"{LAZY_LIBRARIES!r} & sys.modules.keys() or None"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys, jaxfx; sys.exit({loaded})"],
        cwd=ROOT.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"`import jaxfx` loads {done.stderr}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_annotations_are_no_strings(path):
    """Strings for annotations would hide the shapes from jaxtyping."""
    modules = [n.module for n in ast.walk(TREES[path]) if isinstance(n, ast.ImportFrom)]
    assert "__future__" not in modules


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if path.name != "__init__.py"],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_every_module_has_a_test_file(path):
    """Tests mirror the package; the private files of a folder may share that folder's tests."""
    stem = path.stem.strip("_")
    is_shared = path.stem.startswith("_") and path.parent != ROOT
    name = "test_*.py" if is_shared else f"test_{stem}.py"
    folder = TESTS / path.relative_to(ROOT).parent
    assert list(folder.glob(name)), f"there is no {name} in {folder}"


def _value_errors(tree):
    for node in ast.walk(tree):
        call = node.exc if isinstance(node, ast.Raise) else None
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "ValueError":
            message = call.args[0]
            yield message.values[0] if isinstance(message, ast.JoinedStr) else message


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_value_error_opens_with_the_argument_at_fault(path):
    for start in _value_errors(TREES[path]):
        text = start.value if isinstance(start, ast.Constant) else ""
        assert text.startswith("`"), f"line {start.lineno}: {text!r}"


# What belongs to the whole process, and so to its other threads too.
PROCESS_WIDE = re.compile(
    r"contextlib\.redirect_|sys\.std(out|err|in)\b|os\.(chdir|environ|putenv|umask|dup2)\b"
    r"|warnings\.(filter|simple|catch|reset)|(np|numpy)\.(seterr|set_printoptions)"
    r"|random\.seed|matplotlib\.(use|rc)|pyplot|config\.update|basicConfig|setlocale"
    r"|signal\.signal|sys\.(path|setrecursionlimit)|gc\.(set|dis|en)"
)
# How PyOpenGL is told which library to load, before it is imported; and matplotlib, which no
# two threads may use at once, which fonts to put into a file. Neither takes an argument.
MAY_CHANGE_PROCESS = {"scene/opengl.py": {"os.environ"}, "tradeoff.py": {"matplotlib.rc"}}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_process_wide_is_changed(path):
    names = [n for n in ast.walk(TREES[path]) if isinstance(n, ast.Attribute | ast.alias)]
    used = {match.group() for n in names if (match := PROCESS_WIDE.search(ast.unparse(n)))}
    assert used <= MAY_CHANGE_PROCESS.get(path.relative_to(ROOT).as_posix(), set())


# The public face: what `jaxfx` and the modules directly below it list in `__all__`.
PUBLIC_MODULES = ["jaxfx"] + [
    f"jaxfx.{part}" for part in sorted({_part(path) for path in FILES}) if part[0] != "_"
]


def _public_objects():
    """Every public function, class, method and property, by name."""
    found = {}
    for module_name in PUBLIC_MODULES:
        module = importlib.import_module(module_name)
        for name in getattr(module, "__all__", ()):
            value = inspect.unwrap(getattr(module, name, None))
            if not (callable(value) and value.__module__.startswith("jaxfx.")):
                continue
            found[f"{_home(value)}.{name}"] = value
            for member in vars(value) if inspect.isclass(value) else ():
                bound = inspect.getattr_static(value, member)
                if isinstance(bound, functools.cached_property):
                    bound = property(bound.func)
                if not isinstance(bound, property):
                    bound = inspect.unwrap(getattr(value, member))
                is_member = isinstance(bound, property) or inspect.isroutine(bound)
                if is_member and not member.startswith("_"):
                    found[f"{_home(value)}.{name}.{member}"] = bound
    return found


def _home(value):
    return value.__module__.split(".")[1]


PUBLIC_OBJECTS = _public_objects()


@pytest.mark.parametrize("name", PUBLIC_MODULES)
def test_a_public_module_lists_its_names(name):
    module = importlib.import_module(name)
    assert module.__doc__
    assert hasattr(module, "__all__"), f"`{name}` has no `__all__`"
    assert len(module.__all__) == len(set(module.__all__))
    assert all(hasattr(module, public) for public in module.__all__)
    for node in TREES[pathlib.Path(module.__file__)].body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_":
            assert node.name in module.__all__


def _sections(value):
    """A docstring's sections by heading; `Source` too, which has no asterisks."""
    text = re.sub(r"^Source:", "**Source:**", inspect.getdoc(value) or "", flags=re.M)
    parts = re.split(r"^\*\*(\w+):\*\*", text, flags=re.M)
    return {"Summary": parts[0].strip()} | dict(zip(parts[1::2], parts[2::2], strict=True))


def _items(section, names):
    """What is said of each argument: "- `a`, `b`: text", or in one line, with semicolons.

    What stands before the first item is said of every one. "As in" another function will do.
    """
    preface, *texts = re.split(r"^- |(?:^ |; )(?=`)", section, flags=re.M)
    items = dict.fromkeys(names, preface) if preface.strip().startswith("as in `") else {}
    for head, colon, body in (text.partition(":") for text in texts):
        for name in re.findall(r"`\**(\w+)`", head) if colon else ():
            items.setdefault(name, preface + body)
    return items


HELPERS = {
    node.name: node
    for tree in TREES.values()
    for node in tree.body
    if isinstance(node, ast.FunctionDef)
    and not any(name.endswith(f".{node.name}") for name in PUBLIC_OBJECTS)
}


def _raises(node, seen=frozenset()):
    """Whether a function raises, itself or through one of the package that is not public."""
    calls = {ast.unparse(n.func).split(".")[-1] for n in ast.walk(node) if type(n) is ast.Call}
    if "error_if" in calls or any(isinstance(child, ast.Raise) for child in ast.walk(node)):
        return True
    helpers = (calls & HELPERS.keys()) - seen
    return any(_raises(HELPERS[name], seen | helpers) for name in helpers)


def _definitions(value):
    """The syntax tree of a function, or those that construct a class."""
    nodes = [TREES[pathlib.Path(inspect.getsourcefile(value))]]
    for name in value.__qualname__.split("."):
        nodes = [child for n in nodes for child in n.body if getattr(child, "name", "") == name]
    if inspect.isclass(value):
        construct = ("__init__", "__check_init__", "__post_init__")
        nodes = [n for cls in nodes for n in cls.body if getattr(n, "name", "") in construct]
    return nodes


def _is_array(annotation):
    return bool(ARRAY.search(inspect.formatannotation(annotation)))


def _signature_complaints(value, sections):
    is_protocol = getattr(value, "_is_protocol", False)  # It is never called.
    parameters = [
        parameter
        for parameter in inspect.signature(value).parameters.values()
        if parameter.name not in ("self", "cls") and not is_protocol
    ]
    section = sections["Arguments" if "Arguments" in sections else "Summary"]
    items = _items(section, [parameter.name for parameter in parameters])
    for parameter in parameters:
        name = parameter.name
        if name not in items:
            yield f"**Arguments:** has no item for `{name}`"
        elif _is_array(parameter.annotation) and not SHAPE_OR_UNIT.search(items[name]):
            yield f"`{name}`: neither a shape nor a unit"
        is_option = parameter.default is not parameter.empty and name not in DATA
        if is_option and parameter.kind is not parameter.KEYWORD_ONLY and _is_function(value):
            yield f"`{name}` is an option: make it keyword-only"
    if _is_effect(value):
        data = [p.name for p in parameters if p.kind is not p.KEYWORD_ONLY]
        if not set(data) <= set(DATA) or data != sorted(data, key=DATA.index):
            yield f"{data} by position: the data, in this order, are {DATA}"


def _is_function(value):
    return not inspect.isclass(value)


def _is_effect(value):
    """Whether `value` is a function of an effect's public face."""
    return _home(value) in EFFECTS and _is_function(value) and "." not in value.__qualname__


def _docstring_complaints(value, sections):
    returns = inspect.signature(value).return_annotation
    is_protocol = getattr(value, "_is_protocol", False)
    is_record = is_protocol or ("Arguments" not in sections and not _is_function(value))
    if _is_function(value) and returns is not None and "Returns" not in sections:
        yield "no **Returns:**"
    gradient = sections.get("Gradient", "")
    if not gradient and not is_record:
        yield "no **Gradient:**"
    if gradient and _home(value) in HOST and not re.search(r"\b[Nn]o(ne)?\b", gradient):
        yield "**Gradient:** does not say that none passes"
    if _is_effect(value) and "Source" not in sections:
        yield "no Source:"
    names_error = re.search(r"`\w*(Error|Exception)`|\bas `", sections.get("Raises", ""))
    if any(map(_raises, _definitions(value))) and not names_error:
        yield "**Raises:** names no exception"


def _complaints(value):
    """What the docstring and the signature of a public name fall short of.

    A record, a class that only a function's result is, lists its fields without a heading.
    """
    getter = value.fget if isinstance(value, property) else None
    sections = _sections(getter or value)
    if not sections["Summary"]:
        yield "no docstring"
    elif getter:
        is_array = _is_array(inspect.signature(getter).return_annotation)
        if is_array and not SHAPE_OR_UNIT.search(sections["Summary"]):
            yield "neither a shape nor a unit"
    elif not (inspect.isclass(value) and issubclass(value, Exception)):
        yield from _signature_complaints(value, sections)
        yield from _docstring_complaints(value, sections)


@pytest.mark.parametrize("name", sorted(PUBLIC_OBJECTS))
def test_a_public_name_is_documented(name):
    complaints = list(_complaints(PUBLIC_OBJECTS[name]))
    assert not complaints, f"{name}: " + "; ".join(complaints)


def test_the_checks_name_every_folder_of_tests_and_no_other():
    script = TESTS.parent / ".ci" / "run"
    if not script.exists():
        pytest.skip("a source distribution holds no .ci")
    named = set(re.findall(r"\btests/(\w+)(?=[ \n])", script.read_text(encoding="utf-8")))
    paths = [path.relative_to(TESTS).parts[0] for path in TESTS.rglob("test_*.py")]
    folders = {path for path in paths if (TESTS / path).is_dir()}
    assert named == folders - {"helpers"}  # whose only tests are quick ones
