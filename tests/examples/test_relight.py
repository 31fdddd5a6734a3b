"""The relighting example, run as a user runs it: in a process of its own, at a tiny size."""

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


SCRIPT = Path(__file__).parents[2] / "examples" / "relight.py"


def run(*arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, text=True)


@pytest.fixture(scope="module", params=["mesh", "warp"])
def done(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param) / "made" / "anew"
    return out, run("--size", 48, "--frames", 6, "--depth", request.param, "--out", out)


def test_it_ends_well_and_writes_three_files(done):
    out, process = done
    assert process.returncode == 0, process.stderr
    names = sorted(path.name for path in out.iterdir())
    assert names == ["relight.gif", "report.json", "sheet.png"]


def test_the_gif_shows_every_frame_and_the_light_moves(done):
    with Image.open(done[0] / "relight.gif") as gif:
        assert (gif.n_frames, gif.size) == (6, (64, 48))
        frames = []
        for i in range(6):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB"), float))
    assert all(frame.std() > 20 for frame in frames)
    change = [np.abs(b - a).mean() for a, b in itertools.pairwise(frames)]
    assert min(change) > 1


def test_the_report_has_the_time_of_each_frame_and_is_near_fresh_caches(done):
    report = json.loads((done[0] / "report.json").read_text())
    frames = report["frames"]
    assert [frame["kind"] for frame in frames] == ["edit"] * 3 + ["new view"] * 3
    assert report["size"] == [48, 64]
    for frame in frames:
        assert frame["milliseconds"] == pytest.approx(sum(frame["steps"].values()))
        assert min(frame["steps"].values()) > 0
        # A cache of four views, of an image as coarse as its textures.
        assert frame["psnr"] > 17
    assert {"depth", "synthesize", "fill", "shadow", "shade", "image"} == {*frames[-1]["steps"]}
    assert {"shadow", "edit", "image"} == {*frames[0]["steps"]}


def test_what_will_not_do_is_said_in_a_line(tmp_path):
    missing = run("--scene", tmp_path / "none.obj", "--out", tmp_path)
    assert missing.returncode == 1
    assert missing.stderr.startswith("relight.py: error: `scene.load(path)` must be a file")
    small = run("--size", 3, "--out", tmp_path)
    assert small.returncode == 2
    assert small.stderr.splitlines()[-1].endswith("--size must be at least 16, got 3")
