"""The package as a whole: what its import loads, what it lists, and its metadata."""

import importlib.metadata
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxfx


ROOT = Path(jaxfx.__file__).parent
PUBLIC_MODULES = {
    module.name for module in pkgutil.iter_modules(jaxfx.__path__) if module.name[0] != "_"
}
# Modules of types, whose names `jaxfx` itself exports.
TYPES = {"camera", "gbuffer", "lens", "light", "transfer"}


def run(code):
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_module_is_loaded_when_it_is_first_used():
    loaded = (
        "[m for m in sys.modules if m[:6] == 'jaxfx.' and m.count('.') == 1 and m[6] != '_']"
    )
    code = f"import sys, jaxfx; print(*{loaded}); jaxfx.blur.gaussian; print('-', *{loaded})"
    before, after = " ".join(run(code)).split("-")
    assert {name.partition(".")[2] for name in before.split()} == TYPES
    assert {name.partition(".")[2] for name in after.split()} == TYPES | {"blur"}


def test_every_public_module_is_listed_and_reached():
    assert set(dir(jaxfx)) >= PUBLIC_MODULES | set(jaxfx.__all__) | {"__version__"}
    for name in PUBLIC_MODULES:
        assert getattr(jaxfx, name).__name__ == f"jaxfx.{name}"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="`jaxfx` has no attribute 'blurr'"):
        _ = jaxfx.blurr


def test_versions_agree():
    assert importlib.metadata.version("jaxfx") == jaxfx.__version__
    citation = (ROOT.parent / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == jaxfx.__version__


def test_types_are_published():
    assert (ROOT / "py.typed").is_file()


def test_no_newer_python_is_forbidden():
    metadata = importlib.metadata.metadata("jaxfx")
    assert metadata["Requires-Python"] == ">=3.11"
