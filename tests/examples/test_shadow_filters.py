"""The example of shadow filters, in this process, at a tiny size."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


SCRIPT = Path(__file__).parents[2] / "examples" / "shadow_filters.py"
FILES = {"steps.png", "sizes.png", "report.json"}
TINY = ("--size", 32, "--map-size", 48, "--filters", 3)
# A plate over a floor, y up.
PLATE = """v -4 0 -4
v 4 0 -4
v 4 0 4
v -4 0 4
v -1 1 -1
v 1 1 -1
v 1 1 1
v -1 1 1
f 1 4 3
f 1 3 2
f 5 8 7
f 5 7 6
"""


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("shadow_filters", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    module.plt.close("all")


@pytest.fixture(scope="module")
def run(example):
    def main(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["shadow_filters.py", *map(str, arguments)])
            example.main()

    return main


@pytest.fixture(scope="module", params=["still life", "plate"])
def out(request, run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shadows")
    (folder / "plate.obj").write_text(PLATE)
    mesh = () if request.param == "still life" else ("--scene", folder / "plate.obj")
    run(*mesh, *TINY, "--out", folder / "made" / "anew")
    return folder / "made" / "anew"


def test_it_writes_two_figures_and_a_report(out):
    assert {path.name for path in out.iterdir()} == FILES
    for name in ("steps.png", "sizes.png"):
        with Image.open(out / name) as picture:
            assert np.asarray(picture).std() > 20


def test_the_depth_mask_saves_comparisons_and_loses_nothing(out):
    records = json.loads((out / "report.json").read_text())["filters"]
    full, depth, screen = records
    assert [r["method"] for r in records] == ["full", "depth mask", "screen mask"]
    assert full["comparisons"] == 32**2 * 3**2
    assert depth["differing"] == full["differing"] == 0
    for record, tests in ((depth, 2), (screen, 1)):
        assert 0 < record["filtered"] < 0.5
        taps = record["filtered"] * full["comparisons"]
        assert record["comparisons"] == pytest.approx(tests * 32**2 + taps)
        assert record["comparisons"] < full["comparisons"]


def test_a_plate_darkens_the_floor(example, tmp_path):
    (tmp_path / "plate.obj").write_text(PLATE)
    stage = example.set_stage(tmp_path / "plate.obj", 32, 48)
    visible = np.asarray(example.shadow.hard(*stage[:2], bias=stage.bias, slope_bias=1.5))
    # The plate is a sixteenth of the floor; some of its shadow lies behind it.
    assert 0.005 < 1 - visible.mean() < 0.1
    bright, dark = (stage.picture(np.full((32, 32), v)) for v in (1.0, 0.0))
    picture = stage.picture(visible)
    np.testing.assert_array_equal(picture, np.where(visible[..., None], bright, dark))
    assert bright.mean() > 1.5 * dark.mean()


FAULTS = {
    "missing.obj": "must be a file, got 'missing.obj'",
    "broken.glb": "must be a mesh that can be read, got 'broken.glb'",
    "empty.obj": "must hold at least one triangle, got none",
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_scene_that_will_not_do_is_one_line(run, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path("broken.glb").write_text("glTF?")
    Path("empty.obj").write_text("")
    with pytest.raises(SystemExit) as caught:
        run("--scene", name)
    assert caught.value.code.startswith("shadow_filters.py: error: ")
    assert FAULTS[name] in caught.value.code
    assert "\n" not in caught.value.code
    assert not list(Path("out").iterdir())


def test_out_that_can_not_be_written_is_said_first(run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match="--out must be a folder to write to") as caught:
        run("--out", tmp_path / "file", "--scene", "missing.obj")
    assert caught.value.code.startswith("shadow_filters.py: error: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--size", 4), "--size must be at least 16, got 4"),
        (("--map-size", 4), "--map-size must be at least 16, got 4"),
        (("--dilation", 0), "--dilation must be at least 1, got 0"),
        (("--filters", 3, 4), "--filters must be odd numbers from 1, got 4"),
    ],
)
def test_a_number_out_of_range_is_refused(run, capsys, arguments, message):
    with pytest.raises(SystemExit) as caught:
        run(*arguments)
    assert caught.value.code == 2
    assert f"error: {message}" in capsys.readouterr().err


def test_a_figure_that_can_not_be_written_leaves_no_piece(example, tmp_path, monkeypatch):
    figure = example.plt.figure()

    def broken(buffer, **_):
        buffer.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(figure, "savefig", broken)
    with pytest.raises(OSError, match="disk full"):
        example.save(figure, tmp_path / "steps.png")
    assert not list(tmp_path.iterdir())
