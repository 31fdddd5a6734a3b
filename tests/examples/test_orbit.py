"""The orbit example at a tiny size."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxfx import exr


SCRIPT = Path(__file__).parents[2] / "examples" / "orbit.py"


@pytest.fixture
def run(monkeypatch):
    spec = importlib.util.spec_from_file_location("orbit", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, arguments)])
        module.main()

    return call


def test_a_mesh_gives_a_gif_and_a_sheet_with_the_truth_below(run, tmp_path):
    run("--size", 40, "--frames", 5, "--degrees", 4, "--out", tmp_path / "made")
    with Image.open(tmp_path / "made" / "orbit.gif") as gif:
        assert gif.n_frames == 5 and gif.size == (40, 40)
    sheet = np.asarray(Image.open(tmp_path / "made" / "orbit.png")).astype(float)
    assert sheet.shape == (80, 200, 3)
    # In the middle nothing is turned: the image is the rendered one.
    np.testing.assert_array_equal(sheet[:40, 80:120], sheet[40:, 80:120])
    # To the side it is nearer to the turned render than to the one from the front.
    shown, truth, front = sheet[:40, 120:160], sheet[40:, 120:160], sheet[40:, 80:120]
    is_grey = np.ptp(shown, axis=-1) == 0
    assert 0.05 < is_grey.mean() < 0.5
    error = lambda other: np.abs(shown - other)[~is_grey].mean()
    assert error(truth) < 0.6 * error(front)


def test_a_picture_with_depth(run, tmp_path):
    image = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    channels = {"": image, "depth": np.full((12, 16), 2.0, np.float32)}
    exr.write(tmp_path / "view.exr", channels)
    run("--image", tmp_path / "view.exr", "--frames", 5, "--out", tmp_path)
    sheet = np.asarray(Image.open(tmp_path / "orbit.png"))
    assert sheet.shape == (12, 80, 3)
    assert len(np.unique(sheet[:, 32:48].reshape(-1, 3), axis=0)) > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--scene", "missing.obj"), r"^orbit\.py: error: "),
        (("--frames", 1), "2"),
        (("--fov", 180), "2"),
    ],
)
def test_faults_are_one_line(run, tmp_path, arguments, message):
    with pytest.raises(SystemExit, match=message):
        run(*arguments, "--out", tmp_path)
