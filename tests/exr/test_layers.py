"""EXR files: every bit is read back, names, and writing whole or not at all."""

import os
import pathlib
import stat
import subprocess
import sys
import tempfile

import hypothesis as hyp
import hypothesis.strategies as st
import numpy as np
import OpenEXR
import pytest

from jaxfx import exr


DTYPES = [np.float16, np.float32, np.uint32]

# Views of an array that are not contiguous.
LAYOUTS = {
    "plain": lambda a: a,
    "columns first": np.asfortranarray,
    "upside down": lambda a: a[::-1].copy()[::-1],
    "mirrored": lambda a: a[:, ::-1].copy()[:, ::-1],
    "turned": lambda a: a.swapaxes(0, 1).copy().swapaxes(0, 1),
    "every second": lambda a: np.repeat(a, 2, axis=1)[:, ::2],
    "one of several": lambda a: np.stack([a, a], axis=-1)[..., 1],
    "planes": lambda a: np.moveaxis(np.ascontiguousarray(np.moveaxis(a, -1, 0)), 0, -1),
}


def any_bits(rng, shape, dtype):
    """Every kind of number: subnormals, infinities and NaNs with payloads too."""
    count = int(np.prod(shape))
    return np.frombuffer(rng.bytes(count * np.dtype(dtype).itemsize), dtype).reshape(shape)


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for key, array in expected.items():
        assert found[key].dtype == array.dtype
        assert found[key].shape == array.shape
        assert found[key].tobytes() == np.ascontiguousarray(array).tobytes()


def names_in(path):
    return {
        channel.name
        for channel in OpenEXR.File(str(path), header_only=True).header()["channels"]
    }


sizes = st.tuples(st.integers(1, 40), st.integers(1, 40))
layer = st.tuples(
    st.sampled_from([(), (1,), (2,), (3,), (4,)]),
    st.sampled_from(DTYPES),
    st.sampled_from(sorted(LAYOUTS)),
)
keys = st.sampled_from(
    ["depth", "Depth", "left.depth", "normal", "a.B.Normal", "x", "R", "Ä b", "Z.Z"]
)


@hyp.given(sizes, st.dictionaries(keys, layer, min_size=1), st.integers(0, 2**32))
@hyp.settings(max_examples=80, deadline=None)
@hyp.example((1, 1), {"depth": ((), np.float32, "plain")}, 0)
@hyp.example((1, 17), {"normal": ((3,), np.float16, "mirrored")}, 0)
@hyp.example((33, 1), {"x": ((4,), np.uint32, "turned")}, 0)
def test_round_trip(size, layers, seed):
    rng = np.random.default_rng(seed)
    channels = {
        key: LAYOUTS[layout](any_bits(rng, (*size, *channel), dtype))
        for key, (channel, dtype, layout) in layers.items()
    }
    before = {key: array.copy() for key, array in channels.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "picture.exr"
        exr.write(path, channels)
        assert_same(exr.read(path), channels)
    assert_same(channels, before)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_an_image_alone_is_the_main_picture(tmp_path, count):
    image = np.random.default_rng(0).random((5, 4, count), np.float32)
    exr.write(tmp_path / "a.exr", image)
    exr.write(tmp_path / "b.exr", {"": image})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert_same(exr.read(str(tmp_path / "a.exr")), {"": image})


def test_names_that_other_programs_read(tmp_path):
    image = np.zeros((2, 3, 4), np.float32)
    channels = {
        "": image,
        "diffuse": image[:, :, :3],
        "left.Normal": image[:, :, :3],
        "vector": image,
        "uv": image[:, :, :2],
        "mask": image[:, :, :1],
        "depth": image[:, :, 0],
        "roughness": image[:, :, 0],
    }
    exr.write(tmp_path / "a.exr", channels)
    assert names_in(tmp_path / "a.exr") == {
        *("R", "G", "B", "A"),
        *("diffuse.R", "diffuse.G", "diffuse.B"),
        *("left.Normal.X", "left.Normal.Y", "left.Normal.Z"),
        *("vector.X", "vector.Y", "vector.Z", "vector.W"),
        *("uv.X", "uv.Y", "mask.Y", "depth.Z", "roughness.V"),
    }
    header = OpenEXR.File(str(tmp_path / "a.exr"), header_only=True).header()
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    for window in ("dataWindow", "displayWindow"):
        np.testing.assert_array_equal(header[window], [[0, 0], [2, 1]])


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        (np.float64, np.float32),
        (">f4", np.float32),
        (np.bool_, np.uint32),
        (np.uint8, np.uint32),
        (np.uint64, np.uint32),
        (np.int8, np.float32),
        (np.int64, np.float32),
    ],
)
def test_other_numbers(tmp_path, given, stored):
    array = np.array([[0, 1, 1], [1, 0, 1]]).astype(given)
    exr.write(tmp_path / "a.exr", {"x": array})
    assert_same(exr.read(tmp_path / "a.exr"), {"x": array.astype(stored)})


def test_the_edge_of_what_is_stored(tmp_path):
    path = tmp_path / "a.exr"
    wide = np.array([[np.inf, -np.inf, np.nan, 1e-60, 0.1]])
    whole = np.array([[-(2**24), -1, 0, 2**24]])
    large = np.array([[2**32 - 1, 0]], np.uint64)
    for array, dtype in ((wide, np.float32), (whole, np.float32), (large, np.uint32)):
        exr.write(path, {"x": array})
        assert_same(exr.read(path), {"x": array.astype(dtype)})
    for array in (np.array([[1e39]]), whole + 1, -whole - 1, large + np.uint64(1)):
        with pytest.raises(ValueError, match=r"`write\(channels\['x'\]\)` must "):
            exr.write(path, {"x": array})


IMAGE = np.zeros((3, 2, 3), np.float32)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({}, r"`write\(channels\)` must have a channel"),
        ({"x": IMAGE[0, 0]}, r"\(height, width\) or .*, got \(3,\)"),
        ({"x": np.zeros((3, 2, 5))}, r"1 to 4\), .*got \(3, 2, 5\)"),
        ({"x": IMAGE[:0]}, r"got \(0, 2, 3\)"),
        ({"x": IMAGE[:, :, :0]}, r"got \(3, 2, 0\)"),
        ({"": IMAGE[:, :, :2]}, r"1, 3 or 4\); give other data a name, got \(3, 2, 2\)"),
        (IMAGE[:, :, 0], r"1, 3 or 4\); give other data a name, got \(3, 2\)"),
        (
            {"x": IMAGE, "y": IMAGE[:2]},
            r"\['y'\]\)` must have the others' .*\(3, 2\), got \(2, 2\)",
        ),
        (
            {"x": IMAGE.astype(complex)},
            r"`write\(channels\['x'\]\)` must hold real .*complex128",
        ),
        ({"x": IMAGE.astype(str)}, r"must hold real numbers"),
        ({"depth": np.ma.masked_equal(IMAGE[:, :, 0], 0)}, r"\['depth'\]\)` .* got a masked"),
        ({"x": None}, r"\['x'\]\)` must be an array, got None"),
        ({"a\0b": IMAGE}, "must be named by"),
        ({"a" * 254: IMAGE}, "must be named by at most 253 bytes"),
    ],
)
def test_errors_of_write(tmp_path, channels, message):
    with pytest.raises(ValueError, match=message):
        exr.write(tmp_path / "a.exr", channels)
    assert not list(tmp_path.iterdir())


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`write\(path\)` must end in `.exr`.*a.png`"):
        exr.write(tmp_path / "a.png", IMAGE)
    assert not list(tmp_path.iterdir())


def test_the_longest_name(tmp_path):
    exr.write(tmp_path / "a.exr", {"a" * 253: IMAGE})
    assert_same(exr.read(tmp_path / "a.exr"), {"a" * 253: IMAGE})


def refuse(*args, **kwargs):
    raise PermissionError(13, "Permission denied")


@pytest.mark.parametrize("step", ["write_bytes", "replace"])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch, step):
    path = tmp_path / "a.exr"
    exr.write(path, IMAGE)
    before = path.read_bytes()
    monkeypatch.setattr(pathlib.Path, step, refuse)
    with pytest.raises(PermissionError):
        exr.write(path, IMAGE + 1)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == before


def test_folders_that_cannot_be_written(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"cannot write `a.exr` here.*no"):
        exr.write(tmp_path / "no" / "a.exr", IMAGE)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match=r"cannot write `a.exr` here.*file"):
        exr.write(tmp_path / "file" / "a.exr", IMAGE)
    monkeypatch.setattr(pathlib.Path, "touch", refuse)
    with pytest.raises(PermissionError, match=r"cannot write `a.exr` here, Permission denied"):
        exr.write(tmp_path / "a.exr", IMAGE)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_written_file_is_an_ordinary_one(tmp_path):
    """The file's mode follows the umask, and a symbolic link stays one."""
    (tmp_path / "plain").touch()
    (tmp_path / "link.exr").symlink_to(tmp_path / "a.exr")
    exr.write(tmp_path / "link.exr", IMAGE)
    assert (tmp_path / "link.exr").is_symlink()
    modes = {stat.S_IMODE(os.stat(tmp_path / name).st_mode) for name in ("plain", "a.exr")}
    assert len(modes) == 1
    exr.write(tmp_path / "a.exr", {"x": IMAGE})
    assert_same(exr.read(tmp_path / "link.exr"), {"x": IMAGE})


def test_libraries_are_loaded_when_they_are_asked_for():
    code = "import sys, jaxfx.exr; sys.exit({'OpenEXR', 'PIL'} & sys.modules.keys() or None)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
