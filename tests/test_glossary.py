"""One meaning per argument: `docs/arguments.md` has all of them, and docstrings agree."""

import inspect
import re
from pathlib import Path

import pytest

from tests.test_house import PUBLIC_OBJECTS, _items, _sections


PAGE = (Path(__file__).parents[1] / "docs" / "arguments.md").read_text(encoding="utf-8")

# Constructors that take another program's numbers have that program's names and units.
FOREIGN = {f"camera.PinholeCamera.from_{name}" for name in ("blender", "colmap", "nerf")}
FOREIGN |= {f"camera.PinholeCamera.from_{name}" for name in ("opencv", "opengl")}

# A docstring's line names a unit by one of these words.
UNITS = {
    "pixels": r"\bin pixels\b|^(static; )?pixels\b",
    "texels": r"\bin texels\b|^(static; )?(odd, )?texels\b",
    "scene units": r"scene units?\b",
    "radians": r"\bradians?\b",
    "seconds": r"\bseconds\b",
}


def _rows():
    """For each argument of the page: its meaning and the units that it may have."""
    found = {}
    for names, meaning, unit in re.findall(r"^\| (`.*?) \| (.*?) \|(.*?)\|$", PAGE, re.M):
        for name in re.findall(r"`(\w+)`", names):
            assert name not in found, f"`{name}` has two rows"
            found[name] = meaning, unit
    return found


ROWS = _rows()


def _lines():
    """Every public argument as (function, name, what the docstring says of it)."""
    for function, value in PUBLIC_OBJECTS.items():
        if isinstance(value, property) or getattr(value, "_is_protocol", False):
            continue
        is_class = inspect.isclass(value)
        sections = _sections(value)
        is_record = is_class and "Arguments" not in sections
        if is_record or function in FOREIGN or (is_class and issubclass(value, Exception)):
            continue
        names = [
            name for name in inspect.signature(value).parameters if name not in ("self", "cls")
        ]
        said = _items(sections.get("Arguments", sections["Summary"]), names)
        for name in names:
            yield function, name, " ".join(said.get(name, "").lstrip(": ").split())


LINES = list(_lines())


def test_the_page_has_every_argument_and_no_other():
    assert {name for _, name, _ in LINES} == set(ROWS)


@pytest.mark.parametrize(("function", "name", "said"), LINES, ids=lambda x: x[:40])
def test_a_docstring_agrees_with_the_page(function, name, said):
    """What it says of an argument names no unit that the page does not have for it."""
    first = re.split(r"[;.:](?= )", said.removeprefix("static; "))[0]
    for unit, words in UNITS.items():
        if re.search(words, first) and unit.rstrip("s") not in ROWS[name][1]:
            pytest.fail(f"{function}({name}): {first!r}, but the page says {ROWS[name][1]!r}")
