"""The relighting example, run as a user runs it: in a process of its own, at a tiny size."""

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
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


def write_radiance(path, picture):
    """A Radiance file: each channel of a row as runs of equal bytes, or as literal ones."""
    height, width, _ = picture.shape
    exponent = np.frexp(picture.max(axis=2))[1]
    mantissa = np.floor(picture * np.ldexp(256.0, -exponent)[..., None]).clip(0, 255)
    texels = np.concatenate([mantissa, (exponent + 128)[..., None]], axis=2).astype(np.uint8)
    body = bytearray()
    for row in texels:
        body += bytes([2, 2, width >> 8, width & 255])
        for channel in row.T:
            if (channel == channel[0]).all():
                body += bytes([128 + width, channel[0]])
            else:
                body += bytes([width, *channel])
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width)
    path.write_bytes(header + bytes(body))


def test_a_gltf_file_in_surroundings_that_turn(tmp_path):
    """Red to one side, blue to the other: the picture's tint follows the turn."""
    ball = trimesh.creation.icosphere(3)
    gold = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[255, 190, 80, 255], metallicFactor=1.0, roughnessFactor=0.3
    )
    uv = np.zeros((len(ball.vertices), 2))
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=gold)
    ball.export(tmp_path / "ball.glb")
    picture = np.full((16, 32, 3), 0.125)
    picture[:, :16, 0] = 3.0
    picture[:, 16:, 2] = 3.0
    write_radiance(tmp_path / "sides.hdr", picture)
    files = "--scene", tmp_path / "ball.glb", "--environment", tmp_path / "sides.hdr"
    done = run("--size", 32, "--frames", 9, *files, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    frames = json.loads((tmp_path / "out" / "report.json").read_text())["frames"]
    kinds = ["edit"] * 3 + ["turned surroundings"] * 3 + ["new view"] * 3
    assert [frame["kind"] for frame in frames] == kinds
    with Image.open(tmp_path / "out" / "relight.gif") as gif:
        tints = []
        for i in (3, 4, 5):
            gif.seek(i)
            red, _, blue = np.moveaxis(np.asarray(gif.convert("RGB"), float), 2, 0)
            tints.append((red - blue)[:, :21].mean() - (red - blue)[:, 21:].mean())
    assert max(tints) - min(tints) > 10


@pytest.mark.parametrize("content", [b"#?RADIANCE\n\n-Y 2 +X 4\n", b"no picture"])
def test_a_bad_panorama_ends_it_with_one_line(tmp_path, content):
    (tmp_path / "a.hdr").write_bytes(content)
    done = run("--environment", tmp_path / "a.hdr", "--out", tmp_path / "out")
    assert done.returncode != 0 and done.stderr.startswith("relight.py: error:")
    assert "a.hdr" in done.stderr and len(done.stderr.splitlines()) == 1
