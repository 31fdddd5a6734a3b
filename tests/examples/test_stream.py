"""A focus pull through frames on disk: restarted, and in constant memory."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxfx import ThinLens, dof, exr, io


EXAMPLES = Path(__file__).parents[2] / "examples"
RUN = [sys.executable, EXAMPLES / "stream.py"]
OPTIONS = ["--near", "2", "--far", "4", "--aperture", "0.3", "--focal", "20", "--max-coc", "6"]


def make_frames(folder, count, size=(12, 10)):
    rng = np.random.default_rng(0)
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(count):
        io.write_png(folder / "color" / f"{i:04}.png", rng.uniform(0, 1, (*size, 3)))
        np.save(folder / "depth" / f"{i:04}.npy", rng.uniform(1.5, 6, size).astype(np.float32))


def run(folder):
    return subprocess.run([*RUN, folder, *OPTIONS], check=True, capture_output=True, text=True)


def test_frames_are_refocused_and_what_is_written_stays(tmp_path):
    make_frames(tmp_path, 3)
    assert "3/3" in run(tmp_path).stderr
    image = io.read_color(tmp_path / "color" / "0002.png").astype(np.float32)
    depth = np.load(tmp_path / "depth" / "0002.npy")
    expected = dof.scatter(image, depth, ThinLens(0.3, 4.0, 20.0), max_coc=6.0)
    written = tmp_path / "refocused" / "0002.png"
    np.testing.assert_allclose(io.read_color(written), expected, atol=0.005)
    before = written.stat().st_mtime_ns
    (tmp_path / "refocused" / "0001.png").unlink()
    assert "1/1" in run(tmp_path).stderr
    assert written.stat().st_mtime_ns == before


@pytest.mark.parametrize("is_one_file", [True, pytest.param(False, marks=pytest.mark.full)])
def test_exr_frames_with_depth_are_refocused_and_restarted(tmp_path, is_one_file):
    """Linear values, as they are in the file, and a depth beside or inside each."""
    rng = np.random.default_rng(1)
    (tmp_path / "color").mkdir()
    (tmp_path / "depth").mkdir()
    image = rng.uniform(0, 1, (12, 10, 3)).astype(np.float32)
    depth = rng.uniform(1.5, 6, (12, 10)).astype(np.float32)
    for i in range(2):
        color = tmp_path / "color" / f"{i:04}.exr"
        if is_one_file:
            exr.write(color, {"": image, "Z": depth})
        else:
            exr.write(color, image)
            exr.write(tmp_path / "depth" / f"{i:04}.exr", {"Z": depth})
    first, last = (tmp_path / "refocused" / f"{i:04}.png" for i in range(2))
    assert "2/2" in run(tmp_path).stderr
    expected = dof.scatter(image, depth, ThinLens(0.3, 4.0, 20.0), max_coc=6.0)
    np.testing.assert_allclose(io.read_color(last), np.clip(expected, 0, 1), atol=0.005)
    before = last.stat().st_mtime_ns
    first.unlink()
    assert "1/1" in run(tmp_path).stderr
    assert first.exists() and last.stat().st_mtime_ns == before


@pytest.mark.full
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path):
    """480 frames more, with depth and result, are 190 megabytes: they would show."""
    # Both compile: a program that is read from a cache takes less memory.
    env = {name: value for name, value in os.environ.items() if "COMPILATION" not in name}
    peaks = []  # kilobytes
    for count in (20, 500):
        folder = tmp_path / str(count)
        make_frames(folder, count, (120, 120))
        command = [*RUN, folder, *OPTIONS]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=env)
        # Of this process alone: the largest of all children so far could only grow.
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        peaks.append(used.ru_maxrss)
    print(peaks)
    assert peaks[1] < 1.1 * peaks[0], peaks
