"""What the README says, done."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from jaxfx import ThinLens, exr


ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def moved(lens, field, by):
    return ThinLens(**(vars(lens) | {field: getattr(lens, field) + by}))


def test_the_example_runs(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, "README.md", "exec"), names)

    blurred = exr.read("blurred.exr")[""]
    np.testing.assert_array_equal(blurred, names["blurred"])
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
    _, table = TEXT.split("## What there is", 1)
    table, _ = table.split("\n## ", 1)
    calls = re.findall(r"`(\w+)\.(\w+)", table)
    assert len(calls) > 15
    for module, name in calls:
        assert name in importlib.import_module(f"jaxfx.{module}").__all__, f"{module}.{name}"


@pytest.mark.parametrize("target", re.findall(r"\]\(((?!https?:)[^)#]+)\)", TEXT))
def test_every_link_leads_to_a_file(target):
    assert (ROOT / target).is_file()


def test_its_pictures_are_small():
    pictures = [path for path in (ROOT / "docs").iterdir() if path.suffix in (".jpg", ".png")]
    assert all(f"docs/{path.name}" in TEXT for path in pictures)
    assert sum(path.stat().st_size for path in pictures) < 400_000
