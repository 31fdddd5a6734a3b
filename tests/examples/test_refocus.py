"""The refocusing example, on a small photograph made here: a card before a wall, with holes."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxfx import exr, io


pytestmark = pytest.mark.usefixtures("quick")

SCRIPT = Path(__file__).parents[2] / "examples" / "refocus.py"
HEIGHT, WIDTH = 30, 40
NEAR, FAR = 1.0, 2.0


def is_card():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return (abs(y - 15) < 7) & (abs(x - 20) < 9)


@pytest.fixture
def photograph(tmp_path, monkeypatch):
    """`color.png` with a fine pattern; `depth.png` in millimetres, 0 beside the card's left."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    pattern = np.where((x + y) % 2, 0.9, 0.1)
    color = np.stack([pattern, pattern, np.where(is_card(), 0.8, 0.2)], axis=-1)
    io.write_png("color.png", color)
    depth = np.where(is_card(), NEAR, FAR)
    exr.write("depth.exr", {"depth": depth.astype(np.float32)})
    millimetres = (1000 * depth).astype(np.uint16)
    millimetres[10:20, 8:12] = 0
    Image.fromarray(millimetres).save("depth.png")
    return io.read_png("color.png")


@pytest.fixture
def example(monkeypatch):
    spec = importlib.util.spec_from_file_location("refocus", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    module.plt.close("all")


@pytest.fixture
def main(example, monkeypatch):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["refocus.py", *map(str, arguments)])
        example.main()

    return run


def contrast(picture, where):
    """Of the fine pattern, well inside a region."""
    steps = np.abs(np.diff(picture[..., 0], axis=1))
    return steps[where[:, 1:]].mean()


def test_what_is_in_focus_is_sharp_and_the_rest_is_not(photograph, main):
    options = ("--aperture", 0.2, "--focal", 40, "--out", "out")
    main("color.png", "depth.png", "--focus", "20,15", FAR, *options)
    names = {"focus_1", "focus_2"}
    files = {f"{name}.{kind}" for name in names for kind in ("png", "exr")}
    assert {path.name for path in Path("out").iterdir()} == files | {"refocus.png"}

    y, x = np.mgrid[:HEIGHT, :WIDTH]
    card = (abs(y - 15) < 4) & (abs(x - 20) < 6)
    wall = (abs(y - 15) > 11) | (abs(x - 20) > 13)
    near, far = (exr.read(f"out/{name}.exr") for name in sorted(names))
    before = contrast(photograph, card)
    # In focus on the depth's own scale, 16-bit millimetres: untouched.
    np.testing.assert_allclose(near[""][card], photograph[card], atol=1e-3)
    np.testing.assert_allclose(far[""][wall], photograph[wall], atol=1e-3)
    assert contrast(near[""], wall) < 0.3 * before
    assert contrast(far[""], card) < 0.3 * before
    # The lens' own formula: aperture times focal length times the difference of 1 / depth.
    np.testing.assert_allclose(near["coc"][wall], 0.2 * 40 * (1 / NEAR - 1 / FAR), rtol=1e-3)
    shown = io.read_png("out/focus_1.png")
    np.testing.assert_allclose(shown, near[""].clip(0, 1), atol=0.01)


def test_what_is_missing_is_filled_with_the_farther_end(photograph, main):
    main("color.png", "depth.png", "--focus", FAR, "--method", "scatter")
    depth = exr.read("out/focus_2.exr")["depth"]
    np.testing.assert_allclose(depth, np.where(is_card(), NEAR, FAR), rtol=1e-6)


def test_the_rule_for_holes(example):
    nan = np.nan
    depth = np.array(
        [
            [nan, 3, nan, nan, 5, nan],
            [nan, nan, nan, nan, nan, nan],
            [1, nan, 2, nan, 1, 7],
        ],
        np.float32,
    )
    expected = [[3, 3, 5, 5, 5, 5], [3, 3, 5, 5, 5, 7], [1, 2, 2, 2, 1, 7]]
    np.testing.assert_array_equal(example.filled(depth), expected)


def test_depth_of_an_exr_is_in_scene_units_and_the_lens_has_defaults(photograph, main):
    main("color.png", "depth.exr")
    (name,) = Path("out").glob("focus_*.exr")
    found = exr.read(name)
    assert name.stem == "focus_2"
    np.testing.assert_allclose(found["depth"], np.where(is_card(), NEAR, FAR))
    assert found["coc"].max() == pytest.approx(0.025 * WIDTH, rel=1e-3)


def test_a_scale_may_be_a_fraction(photograph, main):
    main(
        "color.png", "depth.png", "--depth-scale", "1/500", "--focus", 4, "--method", "scatter"
    )
    assert exr.read("out/focus_4.exr")["depth"].max() == pytest.approx(4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.png", "depth.png"), "No such file"),
        (("color.png", "color.png"), "must have one channel of depth"),
        (("color.png", "broken.png"), "`broken.png` is damaged or not PNG"),
        (("color.png", "small.png"), r"one height and width, got \(30, 40\) and \(5, 5\)"),
        (("color.png", "empty.png"), "must be known somewhere"),
        (("color.png", "depth.png", "--focus", "40,3"), "must lie in the 40 x 30 picture"),
        (("color.png", "depth.png", "--out", "color.png"), "must be a folder to write to"),
    ],
)
def test_a_fault_is_one_line_and_nothing_is_written(photograph, main, arguments, message):
    Path("broken.png").write_bytes(b"PNG?")
    Image.fromarray(np.ones((5, 5), np.uint16)).save("small.png")
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save("empty.png")
    with pytest.raises(SystemExit, match=message) as caught:
        main(*arguments)
    assert caught.value.code.startswith("refocus.py: error: ")
    assert "\n" not in caught.value.code
    assert not list(Path().glob("out/*"))


@pytest.mark.parametrize("option", ["--focus", "--aperture", "--depth-scale", "--focal"])
def test_a_number_that_is_none_is_refused(main, capsys, option):
    with pytest.raises(SystemExit) as caught:
        main("color.png", "depth.png", option, "0")
    assert caught.value.code == 2
    assert f"argument {option}: must be a number above 0, got '0'" in capsys.readouterr().err


def test_as_a_user_runs_it(photograph):
    command = [sys.executable, str(SCRIPT), "color.png", "depth.png", "--method", "scatter"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "pictures in out\n"
