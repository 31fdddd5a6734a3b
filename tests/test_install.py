"""The built wheel without extras, in an empty environment."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest


pytestmark = pytest.mark.full

ROOT = Path(__file__).parents[1]
PLAIN = {"jax", "numpy", "equinox", "jaxtyping", "optimistix", "scipy"}


def run(*command, cwd=ROOT):
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=outside, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of an environment that holds the wheel and what it requires."""
    folder = tmp_path_factory.mktemp("install")
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT)
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    (wheel,) = folder.glob("*.whl")
    run(python, "-m", "pip", "install", "-q", wheel)
    yield python
    shutil.rmtree(folder / "venv")


def test_every_effect_runs_on_arrays(python, tmp_path):
    script = tmp_path / "bare.py"
    shutil.copy(ROOT / "tests/helpers/bare.py", script)
    assert "functions" in run(python, script, cwd=tmp_path)


def test_nothing_comes_along_that_opens_a_window_a_mesh_or_a_file(python):
    code = "import importlib.metadata as m; print(*(d.name.lower() for d in m.distributions()))"
    names = set(run(python, "-c", code).split())
    assert names >= PLAIN | {"jaxfx"}
    assert not names & {"pillow", "openexr", "trimesh", "pyrender", "pyopengl", "matplotlib"}
