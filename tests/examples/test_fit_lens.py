"""The main example, run as a user runs it: in a process of its own, at a tiny size."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxfx import exr


SCRIPT = Path(__file__).parents[2] / "examples" / "fit_lens.py"
PICTURES = ("reference.exr", "fitted.exr", "fit.png", "chart.png")


def run(*arguments, **options):
    """The exit status and what stood on stderr in the end: bars overwrite themselves."""
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, check=False, **options)
    lines = process.stderr.decode().replace(os.linesep, "\n").split("\n")
    last = (line.rstrip("\r").split("\r")[-1].strip() for line in lines)
    return process.returncode, [line for line in last if line]


def refuse_constant(token):
    raise ValueError(f"JSON has no {token}")


def read_report(folder):
    return json.loads((folder / "report.json").read_text(), parse_constant=refuse_constant)


@pytest.fixture(scope="module")
def still_life(tmp_path_factory):
    out = tmp_path_factory.mktemp("still_life") / "made" / "anew"
    return out, run("--size", 48, "--samples", 8, "--out", out)


def test_it_ends_well_and_writes_five_files(still_life):
    out, (status, lines) = still_life
    assert status == 0, lines
    assert sorted(path.name for path in out.iterdir()) == sorted((*PICTURES, "report.json"))


def test_stderr_tells_the_backend_and_nothing_else(still_life):
    (line,) = still_life[1][1]
    assert line.startswith("scenes are rendered with ")


def test_the_fit_beats_its_start_and_the_pinhole_picture(still_life):
    report = read_report(still_life[0])
    assert report["psnr_fitted"] > report["psnr_start"] + 2
    assert report["psnr_fitted"] > report["psnr_pinhole"]


def test_the_report_agrees_with_the_pictures(still_life):
    out, _ = still_life
    report = read_report(out)
    fitted, reference = (exr.read(out / name) for name in ("fitted.exr", "reference.exr"))
    assert fitted[""].shape == reference[""].shape == (48, 48, 3)
    np.testing.assert_array_equal(fitted["depth"], reference["depth"])
    error = np.mean((fitted[""] - reference[""]).astype(np.float64) ** 2)
    assert report["psnr_fitted"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert {"gamma", "epsilon", "aperture", "focus_distance", "seconds"} <= report.keys()


def test_every_point_of_the_chart_is_in_the_report(still_life):
    chart = {point["name"]: point for point in read_report(still_life[0])["chart"]}
    assert {f"multi-pass {count}" for count in (4, 8)} < chart.keys()
    assert "scatter of a given image" in chart
    assert all(point["seconds"] > 0 for point in chart.values())
    assert chart["multi-pass 8"]["psnr"] > chart["multi-pass 4"]["psnr"]


# Three corners in a row, a triangle that no pixel shows.
LINE = "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"
# What the message must say, so that a user can mend it.
FAULTS = {
    "missing.obj": "must be a file, got 'missing.obj'",
    "broken.glb": "must be a mesh that can be read, got 'broken.glb'",
    "empty.obj": "must hold at least one triangle, got none",
    "line.obj": "nothing in view",
}


@pytest.fixture
def example(tmp_path, monkeypatch):
    """The script as a module, in a folder of its own with some files that won't do."""
    monkeypatch.chdir(tmp_path)
    for name, text in (("broken.glb", "glTF?"), ("empty.obj", ""), ("line.obj", LINE)):
        Path(name).write_text(text)
    spec = importlib.util.spec_from_file_location("fit_lens", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def main(*arguments):
        monkeypatch.setattr(sys, "argv", ["fit_lens.py", *arguments])
        with pytest.raises(SystemExit) as caught:
            module.main()
        return caught.value.code

    return main


@pytest.mark.parametrize("name", FAULTS)
def test_a_scene_that_will_not_do_is_one_line(example, name):
    message = example("--scene", name, "--size", "16", "--samples", "4")
    assert message.startswith("fit_lens.py: error: ")
    assert FAULTS[name] in message
    assert "\n" not in message


@pytest.mark.parametrize("out", ["line.obj", "line.obj/out"])
def test_out_that_can_not_be_written_is_said_before_the_scene_is_read(example, out):
    message = example("--out", out, "--scene", "missing.obj")
    assert message.startswith("fit_lens.py: error: --out must be a folder to write to: ")
    assert out in message


@pytest.mark.parametrize(
    ("option", "value", "least"),
    [("--size", "4", 16), ("--samples", "1", 4), ("--seed", "-1", 0)],
)
def test_a_number_out_of_range_is_refused(example, capsys, option, value, least):
    assert example(option, value) == 2
    assert f"error: {option} must be at least {least}, got {value}" in capsys.readouterr().err


def test_help_says_what_is_written(example, capsys):
    assert example("--help") == 0
    text = capsys.readouterr().out
    assert all(name in text for name in (*PICTURES, "report.json"))


def test_a_fault_reaches_the_shell(tmp_path):
    status, (line,) = run("--scene", "missing.obj", cwd=tmp_path)
    assert status == 1
    assert line == ("fit_lens.py: error: `scene.load(path)` must be a file, got 'missing.obj'.")
