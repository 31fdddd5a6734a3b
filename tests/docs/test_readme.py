"""What the README says, done."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from jaxfx import ThinLens, io


ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def moved(lens, field, by):
    return ThinLens(**(vars(lens) | {field: getattr(lens, field) + by}))


@pytest.mark.full
def test_the_example_runs(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, "README.md", "exec"), names)

    blurred = io.read_png("blurred.png")
    # Eight bits of sRGB: half a step at white is 1 / 255 / 2 times its slope there.
    np.testing.assert_allclose(blurred, np.clip(names["blurred"], 0, 1), atol=5e-3)
    assert np.abs(blurred - names["image"]).max() > 0.1

    gradient = names["gradient"]
    assert isinstance(gradient, ThinLens)
    for field, derivative in vars(gradient).items():
        # A difference quotient of float32 values: good for two digits.
        step = 1e-3 * float(getattr(names["lens"], field))
        above, below = (
            float(names["sharpness"](moved(names["lens"], field, by))) for by in (step, -step)
        )
        assert float(derivative) == pytest.approx((above - below) / (2 * step), rel=0.05)


def test_every_call_that_it_lists_exists():
    _, table = TEXT.split("## I want", 1)
    table, _ = table.split("\n## ", 1)
    calls = re.findall(r"`(\w+)\.(\w+)", table)
    assert len(calls) > 15
    for module, name in calls:
        assert name in importlib.import_module(f"jaxfx.{module}").__all__, f"{module}.{name}"


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
# The site's front page links to pages that `docs/build.py` makes, and which it checks.
PAGES.remove(ROOT / "docs" / "index.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(((?!https?:)[^)#]+)\)", text):
        assert (page.parent / target).is_file(), target


def test_images_are_shown_and_small():
    images = [path for path in (ROOT / "docs").iterdir() if path.suffix in (".jpg", ".png")]
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert all(path.name in text for path in images)
    assert sum(path.stat().st_size for path in images) < 400_000
