"""Build the documentation site: `pip install -e '.[docs]' && python docs/build.py`.

Copies the pages of this folder to `build/docs`, writes the pages that are made from docstrings
and notebooks beside them, lets Zensical build `build/site`, and checks each page of the result:
every link and anchor leads somewhere, nothing is loaded from the network, and a page with all
that it loads is lighter than `PAGE_BYTES`.
"""

import base64
import html.parser
import importlib
import inspect
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

import latex2mathml.converter
import nbformat


DOCS = Path(__file__).parent
ROOT = DOCS.parent
PAGES = ROOT / "build" / "docs"
SITE = ROOT / "build" / "site"
# What a page may weigh, with its images, styles and scripts: a few seconds on a slow line.
PAGE_BYTES = 1_500_000

MODULES = (
    *("jaxfx", "dof", "blur", "reproject", "shadow", "relight", "fit", "budget", "sharding"),
    *("depth", "scene", "exr", "io", "metrics", "tradeoff"),
)
GUIDES = (
    *("depth_of_field", "lens", "focal_stack", "blur", "reproject", "shadow", "relight"),
    *("fitting", "charts"),
)


# Sliders that open a guide: frames of `docs/gallery`, how many, the first one shown, the text
# in place of the image, and what the slider's two ends mean.
SLIDERS = {
    "depth_of_field": ("focus", 13, 6, "A scene whose focus moves", "far", "near"),
    "shadow": ("light", 13, 4, "A scene whose lamp moves around it", "right", "left"),
}


# The image that opens each other guide, and what is seen on it.
OPENINGS = {
    "reproject": (
        "gallery/new_view.jpg",
        "A scene from a camera to the side, grey where unseen",
    ),
    "relight": ("gallery/relighting.jpg", "A scene under a red, a green and a blue lamp"),
    "fitting": ("fit.jpg", "A pinhole image, the scene through a lens, and the fitted lens"),
    "charts": ("chart.png", "Milliseconds against error of methods for depth of field"),
}
# Cells of code with more lines are folded.
OPEN_LINES = 14


def module_of(name: str):
    """A module by the name of its page."""
    return importlib.import_module("jaxfx" if name == "jaxfx" else f"jaxfx.{name}")


def public(name: str) -> dict[str, object]:
    """Public classes and functions of a module by name, in the order of `__all__`."""
    module = module_of(name)
    values = {each: getattr(module, each) for each in module.__all__}
    return {key: value for key, value in values.items() if callable(value)}


def anchors() -> dict[str, str]:
    """Page and anchor of each public name, as it is written in texts."""
    places = {}
    for module in MODULES:
        for name in public(module):
            place = f"api/{module}.md#{name.lower()}"
            if module == "jaxfx":
                places[name] = place
            else:
                places[f"{module}.{name}"] = place
            places[f"jaxfx.{module}.{name}"] = place
    return places


def linked(text: str, up: str, places: dict[str, str], page: str = "") -> str:
    """Markdown whose public names in backticks lead to the reference, as notebooks to guides.

    Code stays as it is.
    """

    def link(match):
        place = places.get(match[1].split("(")[0])
        return f"[`{match[1]}`]({up}{place})" if place and place != page else match[0]

    parts = re.split(r"(```.*?```|<[^>]+>|\[[^\]]*\]\([^)]*\))", text, flags=re.DOTALL)
    parts[::2] = [
        re.sub(r"(?<![`\[])`([\w.]+(?:\([^`]*\))?)`(?!`)", link, s) for s in parts[::2]
    ]
    return re.sub(r"\]\(\.\./notebooks/(\w+)\.ipynb\)", rf"]({up}guides/\1.md)", "".join(parts))


def fenced(doc: str) -> str:
    """A docstring as Markdown: its examples, which begin with `>>>`, become blocks of code."""
    lines, inside = [], False
    # A row of a table that goes on in the next line has no first cell there.
    text = inspect.cleandoc(doc).replace(", |\n| | ", ", ")
    for line in text.splitlines():
        if line.startswith(">>>") and not inside:
            lines.append("```pycon")
            inside = True
        elif inside and not line.strip():
            lines.append("```")
            inside = False
        lines.append(line)
    return "\n".join([*lines, "```"] if inside else lines)


def signature(name: str, value) -> str:
    """The call with its defaults; the docstring has shapes and units."""
    try:
        parameters = inspect.signature(value).parameters.values()
    except ValueError:
        return name
    plain = [p.replace(annotation=inspect.Parameter.empty) for p in parameters]
    return name + str(inspect.Signature(plain))


def members(value) -> Iterator[tuple[str, object]]:
    """Public methods and properties that a class defines itself and that have a docstring."""
    for name, member in vars(value).items():
        function = getattr(member, "__func__", getattr(member, "fget", None) or member)
        is_public = not name.startswith("_") and inspect.isfunction(inspect.unwrap(function))
        if is_public and function.__doc__:
            yield name, member


def reference(module: str, places: dict[str, str]) -> str:
    """The page of a module: its docstring, then each public name."""
    full = "jaxfx" if module == "jaxfx" else f"jaxfx.{module}"
    parts = [f"# {full}", fenced(module_of(module).__doc__)]
    for name, value in public(module).items():
        parts += [f"## {name} {{ #{name.lower()} }}"]
        parts += [
            f"```python\n{signature(f'{full}.{name}', value)}\n```",
            fenced(value.__doc__ or ""),
        ]
        for member, function in members(value) if inspect.isclass(value) else ():
            doc = inspect.getdoc(getattr(value, member))
            if isinstance(function, property):
                call = f"{name}.{member}"
            else:
                call = signature(f"{name}.{member}", getattr(value, member))
            parts += [f"### {name}.{member}", f"```python\n{call}\n```", fenced(doc or "")]
    return linked("\n\n".join(parts), "../", places)


def gradients(places: dict[str, str]) -> str:
    """A table of the Gradient line of each function."""
    text = """# Gradients

What can be differentiated, and where a derivative is zero, biased or missing: the Gradient
lines of all public functions and classes. Each is tested in forward and reverse mode against
finite differences in float64.
"""
    rows = [text, "| call | gradient |", "|---|---|"]
    for module in MODULES:
        for name, value in public(module).items():
            doc = inspect.cleandoc(value.__doc__ or "")
            found = re.search(r"\*\*Gradients?:\*\*(.*?)(?:\n\n|\Z)", doc, re.DOTALL)
            if found:
                line = " ".join(found[1].split()).replace("|", "‖")
                call = name if module == "jaxfx" else f"{module}.{name}"
                rows.append(f"| `{call}` | {line[:1].upper()}{line[1:]} |")
    return linked("\n".join(rows), "", places)


def which(places: dict[str, str]) -> str:
    """The tables at the head of the packages' docstrings."""
    titles = {
        "dof": "Depth of field",
        "reproject": "New views",
        "shadow": "Shadows",
        "relight": "Relighting",
        "fit": "Fitting",
        "budget": "The quickest within an error",
    }
    parts = ["# I want … → call"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    parts += [readme.split("## I want …")[1].split("\n\n")[1]]
    parts = [linked("\n\n".join(parts).replace("](docs/", "]("), "", places)]
    for module, title in titles.items():
        doc = fenced(module_of(module).__doc__)
        # Calls of a table are written without their module.
        body = re.sub(
            r"`(\w+)(\([^`]*\))?`",
            lambda m, module=module: (
                f"`{module}.{m[1]}{m[2] or ''}`" if f"{module}.{m[1]}" in places else m[0]
            ),
            doc,
        )
        parts.append(f"## {title}\n\n{linked(body, '', places)}")
    return "\n\n".join(parts)


def with_formulas(text: str) -> str:
    """LaTeX between dollars as MathML, which browsers draw without a script."""

    def formula(match):
        latex = match[1] or match[2]
        # Commands that the converter does not know.
        for command, known in (
            (r"\lVert", "‖"),
            (r"\rVert", "‖"),
            (r"\arg", r"\operatorname{arg}"),
        ):
            latex = re.sub(
                re.escape(command) + r"(?=\W|min)", lambda _, known=known: known, latex
            )
        math = latex2mathml.converter.convert(latex, display="block" if match[1] else "inline")
        return f'\n\n<div class="formula">{math}</div>\n\n' if match[1] else math

    parts = re.split(r"(```.*?```|`[^`]*`)", text, flags=re.DOTALL)
    pattern = r"\$\$(.+?)\$\$|\$([^$]+?)\$"
    parts[::2] = [re.sub(pattern, formula, part, flags=re.DOTALL) for part in parts[::2]]
    return "".join(parts)


def slider(name: str) -> str:
    """HTML of the slider of a guide; without JavaScript, one frame."""
    stem, count, first, text, low, high = SLIDERS[name]
    return (
        f'<div class="frames" data-stem="../gallery/{stem}_" data-count="{count}">'
        f'<img src="../gallery/{stem}_{first:02}.jpg" alt="{text}" width="320" height="240">'
        f'<label>{low} <input type="range" min="0" max="{count - 1}" value="{first}"'
        f' aria-label="{text}: {low} to {high}"> {high}</label></div>'
    )


def guide(name: str, places: dict[str, str]) -> str:
    """A notebook as a page: its texts, code and kept outputs; images become files."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", 4)
    folder = PAGES / "guides"
    parts, count = [], 0
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(linked(with_formulas(cell.source), "../", places))
            if len(parts) == 1 and name in SLIDERS:
                parts.append(slider(name))
            if len(parts) == 1 and name in OPENINGS:
                source, text = OPENINGS[name]
                parts.append(f"![{text}](../{source})")
            continue
        code = f"```python\n{cell.source}\n```"
        lines = cell.source.count("\n") + 1
        if lines > OPEN_LINES:
            needs = ", in a checkout of the sources" if "benchmarks" in cell.source else ""
            summary = f"<summary>Code, {lines} lines{needs}</summary>"
            code = f"<details markdown>\n{summary}\n\n{code}\n\n</details>"
        parts.append(code)
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data or "image/jpeg" in data:
                kind = "png" if "image/png" in data else "jpeg"
                path = folder / f"{name}_{count}.{kind}"
                path.write_bytes(base64.b64decode(data[f"image/{kind}"]))
                parts.append(f"![Figure {count + 1} of this page]({path.name})")
                count += 1
            else:
                text = output.get("text") or data.get("text/plain", "")
                is_shown = "text/html" not in data and "widget" not in str(list(data))
                if text.strip() and is_shown:
                    parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts)


def failures() -> str:
    """The text about failures, then each published case: what is asked, and the figures."""
    parts = [(DOCS / "failures.md").read_text(encoding="utf-8")]
    for path in sorted((DOCS / "stability").glob("*.json")):
        cases = json.loads(path.read_text(encoding="utf-8"))
        parts.append(f"## jaxfx.{path.stem}")
        parts.append(
            f"![Images of all cases and methods of {path.stem}](stability/{path.stem}.png)"
        )
        for name, case in cases.items():
            parts.append(f"### {path.stem}: {name}\n\n{case['says']}")
            asks = case["asks"]
            if not asks:
                continue
            bounds = ("" if v is None else f", at most {v:g}" for v in asks.values())
            heads = [f"{figure}{bound}" for figure, bound in zip(asks, bounds, strict=True)]
            rows = ["| method | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
            for method, figures in case["figures"].items():
                cells = []
                for figure, bound in asks.items():
                    value = figures.get(figure)
                    text = "" if value is None else f"{value:.3g}"
                    fails = value is not None and bound is not None and not value <= bound
                    cells.append(f"**{text}**" if fails else text)
                rows.append(f"| {method} | " + " | ".join(cells) + " |")
            parts.append("\n".join(rows))
    return "\n\n".join(parts)


def write_pages() -> None:
    """All pages in Markdown, with their images."""
    shutil.rmtree(PAGES, ignore_errors=True)
    kinds = {".md", ".png", ".jpg", ".css", ".js", ".json"}
    for path in DOCS.rglob("*"):
        if path.suffix in kinds:
            target = PAGES / path.relative_to(DOCS)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
    places = anchors()
    for path in PAGES.rglob("*.md"):
        up = "../" * (len(path.relative_to(PAGES).parts) - 1)
        path.write_text(linked(path.read_text(encoding="utf-8"), up, places), encoding="utf-8")
    (PAGES / "guides").mkdir()
    (PAGES / "api").mkdir()
    made = {"which": which(places), "gradients": gradients(places)}
    made["failures"] = linked(failures(), "", places)
    made |= {f"guides/{name}": guide(name, places) for name in GUIDES}
    made |= {f"api/{name}": reference(name, places) for name in MODULES}
    for name, source in (("changelog", "CHANGELOG.md"), ("contributing", "CONTRIBUTING.md")):
        made[name] = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
    for name, text in made.items():
        (PAGES / f"{name}.md").write_text(text + "\n", encoding="utf-8")


class _Page(html.parser.HTMLParser):
    """Links, loaded files, anchors and images without a text of one page."""

    def __init__(self, path: Path):
        super().__init__()
        self.links, self.loads, self.ids, self.silent = [], [], set(), []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if "id" in given:
            self.ids.add(given["id"])
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag in ("img", "script", "source") and given.get("src"):
            self.loads.append(given["src"])
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(given["href"])
        if tag == "img" and not given.get("alt"):
            self.silent.append(given.get("src"))


def problems() -> list[str]:
    """The errors on the pages of `SITE`, a line each."""
    # The page of errors is served anywhere: its links begin at the server's root.
    paths = (path for path in sorted(SITE.rglob("*.html")) if path.name != "404.html")
    pages = {path: _Page(path) for path in paths}
    found = []
    for path, page in pages.items():
        name = path.relative_to(SITE)
        found += [f"{name}: image {source} has no alternative text" for source in page.silent]
        weight = path.stat().st_size
        for source in dict.fromkeys(page.loads):
            file = (path.parent / unquote(urlparse(source).path)).resolve()
            if urlparse(source).scheme in ("http", "https") or source.startswith("//"):
                found.append(f"{name}: loads {source} from the network")
            elif urlparse(source).scheme != "data" and not file.is_file():
                found.append(f"{name}: {source} is missing")
            elif file.is_file():
                weight += file.stat().st_size
        if weight > PAGE_BYTES:
            found.append(f"{name}: {weight / 1e6:.2f} MB with all that it loads")
        for href in page.links:
            target, anchor = urldefrag(href)
            if urlparse(target).scheme or target.startswith("//"):
                continue
            file = (path.parent / unquote(target)).resolve() if target else path
            file = file / "index.html" if file.is_dir() else file
            if not file.is_file():
                found.append(f"{name}: link to {href}, which does not exist")
            elif anchor and file in pages and unquote(anchor) not in pages[file].ids:
                found.append(f"{name}: link to {href}, whose anchor does not exist")
    return found


def main() -> None:
    """Write the pages, build the site, check it."""
    write_pages()
    subprocess.run(["zensical", "build", "--clean", "--strict"], cwd=ROOT, check=True)
    found = problems()
    print(*found, sep="\n")
    pages = len(list(SITE.rglob("*.html")))
    if found or not pages:
        sys.exit(f"{len(found)} problems in {pages} pages of {SITE}")
    print(f"{pages} pages in {SITE}")


if __name__ == "__main__":
    main()
