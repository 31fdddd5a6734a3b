"""The atlas, run as a user runs it, of one effect at a tiny size."""

import inspect
import math
import subprocess
import sys
import xml.etree.ElementTree
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from PIL import Image

from benchmarks import atlas
from jaxfx import blur, dof, relight, reproject, shadow


ROOT = Path(__file__).parents[2]
CHARTS = {
    *(
        f"blur_{cost}_{scene}"
        for cost in ("time", "memory")
        for scene in ("still_life", "spikes")
    ),
    *("blur_size", "blur_own"),
}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("atlas") / "made" / "anew"
    options = ["--effects", "blur", "--size", "32", "--quick", "--out", str(folder)]
    command = [sys.executable, "-m", "benchmarks.atlas", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "28 measurements, 6 charts in " in done.stdout
    return folder


@pytest.fixture(scope="module")
def rows(out):
    return atlas.read_rows(out / "atlas.csv")


def test_it_writes_figures_machine_and_every_chart_twice(out):
    files = {f"{chart}.{kind}" for chart in CHARTS for kind in ("png", "svg")}
    assert {path.name for path in out.iterdir()} == files | {"atlas.csv", "atlas.txt"}


def test_rows_are_complete_and_agree_with_themselves(rows):
    case = atlas.atlas_cases.blurred(atlas.Point("spikes", 32, 4))
    settings = {(m, s) for m, each in case.methods.items() for s in each}
    usual = {(method, next(iter(each))) for method, each in case.methods.items()}
    found = {}
    for row in rows:
        found.setdefault(row.at, []).append((row.method, row.setting))
        assert row.milliseconds > 0 and row.spread_milliseconds >= 0 and row.memory_bytes > 0
        assert row.rmse == pytest.approx(10 ** (-row.psnr / 20), rel=1e-2)
    assert {at: set(each) for at, each in found.items()} == {
        ("still life", 32, 4): settings,
        ("spikes", 32, 4): settings,
        ("still life", 16, 4): usual,
        ("still life", 32, 1): usual,
    }
    assert len(rows) == sum(map(len, map(set, found.values())))


def test_an_error_is_what_scipy_makes_it(rows):
    """A Gaussian cut at 2 sigma against one cut at 8, both SciPy's."""
    case = atlas.atlas_cases.blurred(atlas.Point("spikes", 32, 4))
    (image,) = case.data
    row = math.comb(12, 6) + 2 * sum(math.comb(12, k) for k in range(2, 6))
    variance = 2 * sum(math.comb(12, 6 - k) * k * k for k in range(1, 5)) / row
    sigma = math.sqrt(4 * variance)
    both = []
    for reach in (math.ceil(2 * sigma), 40):
        found = np.asarray(image, np.float64)
        for axis in (0, 1):
            how = {"mode": "nearest", "radius": reach, "axis": axis}
            found = scipy.ndimage.gaussian_filter1d(found, sigma, **how)
        both.append(found)
    expected = -10 * np.log10(np.mean((both[0] - both[1]) ** 2))
    (of_two,) = (
        row.psnr
        for row in rows
        if (row.method, row.setting, row.at) == ("one kernel", "2 sigma", ("spikes", 32, 4))
    )
    assert of_two == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("name", sorted(CHARTS))
def test_a_chart_says_what_it_shows(out, rows, name):
    svg = xml.etree.ElementTree.parse(out / f"{name}.svg")
    words = [
        "".join(element.itertext()).strip()
        for element in svg.iter("{http://www.w3.org/2000/svg}text")
    ]
    text = "\n".join(words)
    assert all(row.method in text for row in rows)
    assert (out / "atlas.txt").read_text().strip() in text
    assert f"reference: {atlas.EFFECTS['blur'].truth}" in text
    assert "PSNR to the reference (dB)" in words
    units = {"memory": "(MB)", "size": "(ms, median)", "own": "(ms, median)"}
    assert units.get(name.split("_")[1], "(ms, median)") in text
    if name.endswith(("still_life", "spikes")):
        assert "Pareto front" in words
        assert {"2 sigma", "3 sigma", "4 sigma", "2 taps", "4 taps"} <= set(words)
    with Image.open(out / f"{name}.png") as picture:
        assert np.asarray(picture.convert("L")).std() > 10


def test_rows_survive_the_file(rows, tmp_path):
    unknown = rows[0]._replace(memory_bytes=math.nan, psnr=math.inf, rmse=0.0)
    atlas.write_rows([unknown, *rows], tmp_path / "atlas.csv")
    first, *others = atlas.read_rows(tmp_path / "atlas.csv")
    assert others == rows
    assert math.isnan(first.memory_bytes) and first.psnr == math.inf
    assert first[:7] == unknown[:7]


def test_an_earlier_run_is_drawn_again(out, tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(
        atlas, "charts", lambda rows, key, *_: drawn.append((key, len(rows))) or {}
    )
    options = ["atlas.py", "--csv", str(out / "atlas.csv"), "--out", str(tmp_path / "again")]
    monkeypatch.setattr(sys, "argv", options)
    atlas.main()
    assert drawn == [("blur", 28)]
    assert "28 measurements" in capsys.readouterr().out


# Public names of the effects that make no image by themselves: what others are made with.
PARTS = {
    *("Accumulation", "binomial_weights", "linear_taps", "Candidates", "Receivers"),
    *("candidates", "receivers", "light_cameras", "Choice", "Hit", "choose"),
    *("MovingShadow", "RelightState", "Synthesis", "FilledCache", "LinearTaps"),
    *("capture_normals", "shade", "Iris", "peel", "mirrored", "refracted", "fresnel"),
}


@pytest.mark.parametrize("effect", [dof, blur, reproject, shadow, relight])
def test_every_method_of_an_effect_is_measured(effect):
    source = inspect.getsource(atlas.atlas_cases)
    effect_name = effect.__name__.split(".")[1]
    for name in set(effect.__all__) - PARTS:
        assert f"{effect_name}.{name}" in source, f"the atlas lacks {effect_name}.{name}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "30"], "--size must be a multiple of 4 from 32, got 30"),
        (["--effects", "glow"], "invalid choice: 'glow'"),
    ],
)
def test_an_option_out_of_range_is_refused(monkeypatch, capsys, options, message):
    monkeypatch.setattr(sys, "argv", ["atlas.py", *options])
    with pytest.raises(SystemExit):
        atlas.main()
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "file"], "atlas.py: error: --out must be a folder to write to: "),
        (["--csv", "missing.csv"], "atlas.py: error: --csv must be a file that this command "),
        (["--csv", "file"], "atlas.py: error: --csv must be a file that this command wrote"),
    ],
)
def test_what_can_not_be_read_or_written_is_one_line(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("a,b\n1,2\n")
    monkeypatch.setattr(sys, "argv", ["atlas.py", *options])
    with pytest.raises(SystemExit) as caught:
        atlas.main()
    assert caught.value.code.startswith(message) and "\n" not in caught.value.code
