"""Depth from files: the stored numbers, or an error that names the file."""

import inspect
import zipfile

import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from PIL import Image

from jaxfx import exr, io


FLAT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def steps(dtype=np.uint16, size=(5, 7)):
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, size, dtype)


def metres(dtype=np.float32, size=(5, 7)):
    return np.random.default_rng(1).uniform(0.5, 9, size).astype(dtype)


def assert_read(path, expected):
    found = io.read_depth(path)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_png(tmp_path, dtype):
    Image.fromarray(steps(dtype)).save(tmp_path / "a.png")
    assert_read(tmp_path / "a.png", steps(dtype))


def test_png_of_another_library(tmp_path):
    output = OpenImageIO.ImageOutput.create("png")
    assert output.open(str(tmp_path / "a.png"), OpenImageIO.ImageSpec(7, 5, 1, "uint16"))
    assert output.write_image(steps()[..., None]) and output.close()
    assert_read(tmp_path / "a.png", steps())


def test_colours_that_are_alike_are_grey(tmp_path):
    Image.fromarray(np.stack([steps(np.uint8)] * 3, axis=-1)).save(tmp_path / "a.png")
    assert_read(tmp_path / "a.png", steps(np.uint8))
    exr.write(tmp_path / "a.exr", np.stack([metres()] * 3, axis=-1))
    assert_read(tmp_path / "a.exr", metres())


def palette():
    return Image.fromarray(np.stack([steps(np.uint8)] * 3, axis=-1)).quantize(8)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (palette, "without alpha, to be a depth, got a PNG of a palette"),
        (lambda: Image.fromarray(steps(np.uint8, (5, 7, 3))), "got a PNG of RGB"),
        (lambda: Image.fromarray(steps(np.uint8, (5, 7, 4))), "got a PNG of RGBA"),
        (lambda: Image.fromarray(steps(np.uint8, (5, 7, 2))), "got a PNG of LA"),
        (lambda: Image.fromarray(steps() > 9000), "got a PNG of 1"),
    ],
)
def test_other_png_is_refused(tmp_path, picture, message):
    picture().save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=rf"a.png` must be of grey, .*{message}"):
        io.read_depth(tmp_path / "a.png")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("size", [b"1", b"1.0", b"0.003922", b"1e+0"])
def test_pfm(tmp_path, order, size):
    """The bottom row comes first; the scale's sign is the byte order, its size is ignored."""
    sign = b"-" if order == "<" else b""
    body = metres()[::-1].astype(f"{order}f4").tobytes()
    (tmp_path / "a.pfm").write_bytes(b"Pf\n7 5\n" + sign + size + b"\n" + body)
    assert_read(tmp_path / "a.pfm", metres())


def test_pfm_of_another_library(tmp_path):
    Image.fromarray(metres()).save(tmp_path / "a.pfm")
    assert_read(tmp_path / "a.pfm", metres())


def test_pfm_of_three_channels(tmp_path):
    def write(pixels):
        body = pixels[::-1].astype("<f4").tobytes()
        (tmp_path / "a.pfm").write_bytes(b"PF\n7 5\n-1\n" + body)

    write(np.stack([metres()] * 3, axis=-1))
    assert_read(tmp_path / "a.pfm", metres())
    write(metres(size=(5, 7, 3)))
    with pytest.raises(ValueError, match=r"a.pfm` must have one channel .* \(5, 7, 3\)"):
        io.read_depth(tmp_path / "a.pfm")


@pytest.mark.parametrize(
    "data",
    [
        b"Pf",
        b"Pf\n7 5\n-1\n" + bytes(139),
        b"Pf\n7 5\n-1\n" + bytes(141),
        b"Pf\n7 5\nx\n" + bytes(140),
        b"Pf\n7 5\n0\n" + bytes(140),
        b"Pf\n0 5\n-1\n",
        b"Pf4\n7 5\n-1\n" + bytes(560),
        b"Pf\n7 5\n-1e999\n" + bytes(140),
    ],
)
def test_damaged_pfm(tmp_path, data):
    (tmp_path / "a.pfm").write_bytes(data)
    with pytest.raises(ValueError, match=r"a.pfm` (is damaged|must have one channel)"):
        io.read_depth(tmp_path / "a.pfm")


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint16, ">f4", ">u2"])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 1)])
def test_npy(tmp_path, dtype, shape):
    values = metres(size=shape).astype(dtype)
    np.save(tmp_path / "a.npy", values)
    native = np.dtype(dtype).newbyteorder("=")
    assert_read(tmp_path / "a.npy", values.reshape(5, 7).astype(native))
    np.save(tmp_path / "a.npy", np.asfortranarray(values))
    assert_read(tmp_path / "a.npy", values.reshape(5, 7).astype(native))


def test_npz(tmp_path):
    np.savez(tmp_path / "a.npz", metres())
    assert_read(tmp_path / "a.npz", metres())
    np.savez_compressed(tmp_path / "a.npz", focal=np.float32(3), depth=metres())
    assert_read(tmp_path / "a.npz", metres())
    np.savez(tmp_path / "a.npz", x=metres(), y=metres())
    with pytest.raises(ValueError, match=r"a.npz` must have one array.*\['x', 'y'\]"):
        io.read_depth(tmp_path / "a.npz")


def test_a_text_in_an_npz_is_no_array(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("depth", "a word")
    with pytest.raises(ValueError, match=r"a.npz` must have one array.*\[\]"):
        io.read_depth(path)
    np.save(tmp_path / "z.npy", metres())
    with zipfile.ZipFile(path, "a") as archive:
        archive.write(tmp_path / "z.npy", "z.npy")
    assert_read(path, metres())


@pytest.mark.parametrize(
    "array",
    [
        np.ones(5),
        np.ones((2, 5, 7)),
        np.ones((5, 7), complex),
        np.ones((5, 7)) > 0,
        np.ones((0, 7)),
    ],
)
def test_other_arrays_are_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(ValueError, match=r"a.npy` must have one channel of real numbers"):
        io.read_depth(tmp_path / "a.npy")


def test_objects_are_not_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[{}]]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"a.npy` is damaged or not of NumPy"):
        io.read_depth(tmp_path / "a.npy")


def test_the_depth_of_an_exr_file(tmp_path):
    """The depth is chosen by its name, not by the order of channels."""
    path = tmp_path / "a.exr"
    names = ["A", "AO.V", "B", "G", "R", "Mist.V", "Z"]
    planes = {name: metres() if name == "Z" else 0 * metres() for name in names}
    OpenEXR.File(FLAT.copy(), planes).write(str(path))
    assert_read(path, metres())
    exr.write(
        path, {"": metres(size=(5, 7, 3)), "AO": 0 * metres(), "depth": metres(np.float16)}
    )
    assert_read(path, metres(np.float16))
    exr.write(path, {"ViewLayer.AO": 0 * metres(), "ViewLayer.Depth": metres()})
    assert_read(path, metres())


def test_layers_of_an_exr_file(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, {"Front.Depth": metres(), "Back.Depth": 2 * metres()})
    np.testing.assert_array_equal(io.read_depth(path, layer="Back"), 2 * metres())
    with pytest.raises(
        ValueError, match=r"must have one layer with a depth.*\['Back', 'Front'\]"
    ):
        io.read_depth(path)


@pytest.mark.parametrize("name", ["Y", "R", "Z", "depth.Z", "Depth.Y", "V"])
def test_a_channel_alone(tmp_path, name):
    OpenEXR.File(FLAT.copy(), {name: metres()}).write(str(tmp_path / "a.exr"))
    assert_read(tmp_path / "a.exr", metres())


@pytest.mark.parametrize(
    "channels",
    [
        {"AO": metres()},
        {"A": metres()},
        {"x": metres(), "y": metres()},
        {"": metres(size=(5, 7, 3)), "AO": metres()},
    ],
)
def test_an_exr_file_without_depth_is_refused(tmp_path, channels):
    exr.write(tmp_path / "a.exr", channels)
    with pytest.raises(
        ValueError, match=r"a.exr` must have a pass `Depth` or `Z` of one channel, got \["
    ):
        io.read_depth(tmp_path / "a.exr")
    exr.write(tmp_path / "a.exr", metres(size=(5, 7, 3)))
    with pytest.raises(ValueError, match=r"a.exr` must have one channel of real numbers"):
        io.read_depth(tmp_path / "a.exr")


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(FileNotFoundError):
        io.read_depth(path)
    path.touch()
    with pytest.raises(ValueError, match=r"a.png` must be a PNG, .* got an empty one"):
        io.read_depth(path)
    Image.fromarray(steps(np.uint8)).save(path, "JPEG")
    with pytest.raises(ValueError, match=r"a.png` must be .*: JPEG does not store exact"):
        io.read_depth(path)
    Image.fromarray(steps()).save(path)
    with pytest.raises(ValueError, match=r"a.png` must be an EXR file to have a layer `x`"):
        inspect.unwrap(io.read_depth)(path, layer="x")
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(ValueError, match=r"a.png` is damaged or not PNG"):
        io.read_depth(path)
