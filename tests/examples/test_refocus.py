"""The refocusing example, on a small photograph made here: a card before a wall, with holes."""

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from jaxfx import exr, io


SCRIPT = Path(__file__).parents[2] / "examples" / "refocus.py"
HEIGHT, WIDTH = 30, 40
NEAR, FAR = 1.0, 2.0
PAIR = ("color.png", "depth.png", "--disparity", "--baseline", "1", "--focal", "9")


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
def example():
    spec = importlib.util.spec_from_file_location("refocus", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def options(example, monkeypatch):
    """The script's options, without running it."""

    def parsed(*arguments):
        monkeypatch.setattr(sys, "argv", ["refocus.py", *map(str, arguments)])
        return example.parse()

    return parsed


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


@pytest.mark.parametrize("fill", ["guided", "rows"])
def test_what_is_missing_is_filled_with_what_is_behind(photograph, main, fill):
    main("color.png", "depth.png", "--focus", FAR, "--method", "scatter", "--fill", fill)
    depth = exr.read("out/focus_2.exr")["depth"]
    np.testing.assert_allclose(depth, np.where(is_card(), NEAR, FAR), rtol=1e-6)


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
        (("color.png", "color.png"), "`color.png` must be of grey, 8 or 16 bits"),
        (("color.png", "broken.png"), "`broken.png` must be a PNG, EXR, PFM, NPY or NPZ file"),
        (("color.png",), "`color.png` must be an OpenEXR file"),
        (("depth.exr",), "`depth.exr` must have one layer with an image and a depth"),
        (("color.png", "depth.png", "--disparity"), "must have --disparity-scale, or --base"),
        (("color.png", "depth.png", "--disparity", "--baseline", "1"), "and --focal of a pair"),
        (("color.png", "depth.png", "--baseline", "1"), "--baseline must have --disparity"),
        (("color.png", "depth.png", "--disparity-shift", "1"), "-shift must have --disparity"),
        (("depth.exr", "--offset", "1"), "--offset must have --disparity"),
        (("depth.exr", "--depth-layer", "x"), "--depth-layer must have a file DEPTH"),
        (("color.png", "depth.png", "--depth-layer", "x"), "`depth.png` must be an EXR file"),
        (
            (
                "color.png",
                "depth.png",
                "--disparity",
                "--disparity-scale",
                "1",
                "--offset",
                "1",
            ),
            "--offset must have --baseline",
        ),
        (
            (*PAIR, "--disparity-shift", "1"),
            "--disparity-shift must be without --baseline",
        ),
        (("color.png", "notes.npz"), r"`notes.npz` must have one array, .* got \[\]"),
        (("two\nlines.png", "depth.png"), "`two lines.png` must be a PNG, JPEG, EXR or"),
        (("color.png", "depth.png", "--focus", "1", "--aperture", "1e6"), "exceeds the image"),
        (("color.png", "depth.png", "--behind", "x"), "must be an OpenEXR file"),
        (
            ("color.png", "depth.png", "--behind", "x", "--method", "scatter"),
            "--behind must have --method layered",
        ),
        (("color.png", "small.png"), r"one height and width, got \(30, 40\) and \(5, 5\)"),
        (("color.png", "empty.png"), "`empty.png` must have a depth above 0"),
        (("color.png", "depth.png", "--focus", "40,3"), "must lie in the 40 x 30 image"),
        (("color.png", "depth.png", "--out", "color.png"), "must be a folder to write to"),
    ],
)
def test_a_fault_is_one_line_and_nothing_is_written(photograph, main, arguments, message):
    Path("broken.png").write_bytes(b"PNG?")
    Path("two\nlines.png").write_bytes(b"PNG?")
    with zipfile.ZipFile("notes.npz", "w") as archive:
        archive.writestr("notes.txt", "no array")
    Image.fromarray(np.ones((5, 5), np.uint16)).save("small.png")
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save("empty.png")
    with pytest.raises(SystemExit, match=message) as caught:
        main(*arguments)
    assert caught.value.code.startswith("refocus.py: error: ")
    assert "\n" not in caught.value.code
    assert not list(Path().glob("out/*"))


def wall():
    return np.where(is_card(), NEAR, FAR)


def depth_in_use(main, *arguments):
    main(*arguments, "--focus", FAR, "--method", "scatter")
    return exr.read("out/focus_2.exr")["depth"]


def write_pfm(path, values):
    Path(path).write_bytes(b"Pf\n40 30\n-1.0\n" + values[::-1].astype("<f4").tobytes())


def test_depth_of_any_file(photograph, main):
    """Each says the same depth, in its own way."""
    np.save("metres.npy", wall().astype(np.float16))
    np.save("steps.npy", (1000 * wall()).astype(np.int32))
    write_pfm("metres.pfm", wall())
    for name in ("metres.npy", "steps.npy", "metres.pfm", "depth.exr", "depth.png"):
        np.testing.assert_allclose(depth_in_use(main, "color.png", name), wall(), rtol=1e-6)


def test_disparity(photograph, main):
    """Of a network, up to scale and shift; of a pair in pixels, or in steps of 1 / 256."""
    np.save("relative.npy", (1 / wall() - 0.25) / 0.05)
    options = ("--disparity", "--disparity-scale", 0.05, "--disparity-shift", "1/4")
    found = depth_in_use(main, "color.png", "relative.npy", *options)
    np.testing.assert_allclose(found, wall(), rtol=1e-6)

    pixels = 60 * 0.5 / wall() - 3
    pixels[10:20, 8:12] = np.inf  # no match
    write_pfm("pair.pfm", pixels)
    Image.fromarray(np.where(np.isinf(pixels), 0, 256 * pixels).astype(np.uint16)).save(
        "pair.png"
    )
    options = ("--disparity", "--baseline", 0.5, "--offset", 3, "--focal", 60)
    for name, more in (("pair.pfm", ()), ("pair.png", ("--depth-scale", "1/256"))):
        found = depth_in_use(main, "color.png", name, *options, *more)
        np.testing.assert_allclose(found, wall(), rtol=1e-6)


def test_ray_distance(photograph, main):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    distance = wall() * np.sqrt(1 + ((x - 20) ** 2 + (y - 15) ** 2) / 30**2)
    np.save("distance.npy", distance)
    found = depth_in_use(main, "color.png", "distance.npy", "--ray", "--focal", 30)
    np.testing.assert_allclose(found, wall(), rtol=1e-6)


def multilayer(path):
    """As Blender writes it, in half floats: a card before a sky, and the sky alone behind."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    pattern = np.where((x + y) % 2, 0.9, 0.1)
    planes = {}
    for layer, depth in (("Front", np.where(is_card(), NEAR, 65504)), ("Back", 65504 + 0 * x)):
        for letter in "RGBA":
            planes[f"{layer}.Combined.{letter}"] = pattern.astype(np.float16)
        planes[f"{layer}.Depth.Z"] = depth.astype(np.float16)
        planes[f"{layer}.AO.V"] = pattern.astype(np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(path)


@pytest.mark.parametrize("behind", [(), ("--behind", "Back")])
def test_one_file_of_blender(photograph, main, behind):
    multilayer("render.exr")
    main("render.exr", "--layer", "Front", *behind, "--focus", NEAR, "--aperture", 0.1)
    found = exr.read("out/focus_1.exr")
    np.testing.assert_array_equal(found["depth"], np.where(is_card(), NEAR, np.inf))
    assert found[""].shape == (HEIGHT, WIDTH, 3)
    assert np.isfinite(found[""]).all()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(y - 15) < 4) & (abs(x - 20) < 6)
    assert contrast(found[""], inside) == pytest.approx(0.8, abs=0.01)


def test_layers_of_depth_are_read_by_name_and_converted_alike(photograph, example, options):
    multilayer("render.exr")
    _, depth = example.read(options("color.png", "render.exr", "--depth-layer", "Front"))
    np.testing.assert_array_equal(depth, np.where(is_card(), NEAR, np.inf))

    # Scale and --ray are said of what COLOR holds, and beside a file DEPTH of that alone.
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.sqrt(1 + ((x - 20) ** 2 + (y - 15) ** 2) / 30**2)
    names = ("Front", "Back")
    passes = {f"{name}.Depth": (1000 * FAR * ray).astype(np.float32) for name in names}
    exr.write("rays.exr", passes | {f"{name}.Combined": photograph for name in names})
    said = ("--layer", "Front", "--behind", "Back", "--depth-scale", "1/1000", "--ray")
    one_file = options("rays.exr", *said, "--focal", 30)
    for _, depth in (example.read(one_file), example.read_behind(one_file, (HEIGHT, WIDTH))):
        np.testing.assert_allclose(depth, FAR, rtol=1e-6)
    _, depth = example.read_behind(options("rays.exr", "depth.png", *said), (HEIGHT, WIDTH))
    np.testing.assert_allclose(depth, 1000 * FAR * ray, rtol=1e-6)


def test_what_is_transparent_is_over_black(photograph, example, options):
    """Alpha is straight in PNG, premultiplied in EXR: one picture in either."""
    alpha = np.where(is_card(), 1, np.float32(0.25))[..., None]
    io.write_png("cut.png", np.concatenate([photograph, alpha], axis=2))
    exr.write("cut.exr", np.concatenate([photograph * alpha, alpha], axis=2))
    for name in ("cut.png", "cut.exr"):
        color, _ = example.read(options(name, "depth.png"))
        np.testing.assert_allclose(color, photograph * alpha, atol=0.005)


def test_foci_that_are_nearly_equal_have_files_of_their_own(example):
    assert example.names([1.0, 2.5]) == ["1", "2.5"]
    assert example.names([1.00001, 1.00002]) == ["1.00001", "1.00002"]


def test_a_column_of_pixels_has_a_figure_of_a_bearable_size(tmp_path, example):
    column = np.ones((3000, 1))
    example.save_figure({"a": column[..., None]}, column, column < 0, tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as figure:
        assert figure.height < 2000


def test_an_unwritable_file_is_an_error_that_names_it(photograph, main):
    Path("out/focus_2.exr").mkdir(parents=True)
    with pytest.raises(SystemExit, match=r"error: .*focus_2\.exr"):
        main("color.png", "depth.exr", "--focus", FAR, "--method", "scatter")


def test_a_photograph_in_jpeg(photograph, main):
    """Whatever its name ends in."""
    smooth = np.broadcast_to(np.linspace(40, 200, WIDTH)[None, :, None], (HEIGHT, WIDTH, 3))
    Image.fromarray(smooth.astype(np.uint8)).save("photo.png", "JPEG", quality=100)
    main("photo.png", "depth.exr", "--focus", FAR, "--aperture", 1e-6)
    image = exr.read("out/focus_2.exr")[""]
    np.testing.assert_allclose(image, io.linear_from_srgb(smooth / 255), atol=0.02)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_no_place_of_the_figure_is_blank(photograph, main, count):
    main("color.png", "depth.exr", "--method", "scatter", "--focus", *np.linspace(1, 2, count))
    with Image.open("out/refocus.png") as figure:
        shown = np.asarray(figure.convert("RGB"))
    is_white = (shown == 255).all(axis=2)
    # Neither at the foot nor at the right is there more than a narrow margin.
    rows, columns = (np.flatnonzero(~is_white.all(axis=axis)) for axis in (1, 0))
    assert rows.max() > 0.85 * shown.shape[0]
    assert columns.max() > 0.9 * shown.shape[1]
    assert is_white.mean() < 0.5


@pytest.mark.parametrize("option", ["--focus", "--aperture", "--depth-scale", "--focal"])
def test_a_number_that_is_none_is_refused(main, capsys, option):
    with pytest.raises(SystemExit) as caught:
        main("color.png", "depth.png", option, "0")
    assert caught.value.code == 2
    assert f"argument {option}: must be a number above 0, got '0'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "text", "message"),
    [
        ("--focus", "1e-300", "must be a number of float32, got '1e-300'"),
        ("--aperture", "1e300", "must be a number of float32, got '1e300'"),
        ("--focal", "inf", "must be a number above 0, got 'inf'"),
        ("--disparity-scale", "0", "must be a number above 0, got '0'"),
        ("--offset", "nan", "must be a number, got 'nan'"),
    ],
)
def test_a_number_out_of_range_is_refused(main, capsys, option, text, message):
    with pytest.raises(SystemExit) as caught:
        main("color.png", "depth.png", option, text)
    assert caught.value.code == 2
    assert f"argument {option}: {message}" in capsys.readouterr().err


def test_as_a_user_runs_it(photograph):
    command = [sys.executable, str(SCRIPT), "color.png", "depth.png", "--method", "scatter"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "images in out\n"
