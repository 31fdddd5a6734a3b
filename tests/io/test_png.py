"""PNG files."""

import inspect
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from jaxfx import io


COLOR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}


def paeth(left, up, corner):
    guess = left + up - corner
    return min((left, up, corner), key=lambda value: abs(guess - value))


def chunk(kind, body):
    return (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    )


def png(pixels, facts=b""):
    """A PNG file of `pixels`, 8 or 16 bits; its rows use the five filters in turn.

    `facts` are chunks between its header and its pixels.
    """
    height, width, channels = pixels.shape
    step = channels * pixels.dtype.itemsize
    rows = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder(">")).view(np.uint8)
    rows = rows.reshape(height, -1).tolist()
    stream = bytearray()
    for j, row in enumerate(rows):
        above = rows[j - 1] if j else [0] * len(row)
        stream.append(j % 5)
        for i, value in enumerate(row):
            left, corner = (row[i - step], above[i - step]) if i >= step else (0, 0)
            guesses = (0, left, above[i], (left + above[i]) // 2, paeth(left, above[i], corner))
            stream.append((value - guesses[j % 5]) % 256)
    bits = 8 * pixels.dtype.itemsize
    header = struct.pack(">IIBBBBB", width, height, bits, COLOR_TYPES[channels], 0, 0, 0)
    image = chunk(b"IDAT", zlib.compress(stream))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + facts + image + chunk(b"IEND", b"")


def linear(codes, largest):
    """The definition, in float64: the curve on colours, alpha unchanged."""
    values = codes / largest
    colors = codes.shape[2] - (codes.shape[2] + 1) % 2
    curved = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.concatenate([curved[..., :colors], values[..., colors:]], axis=-1)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_read_any_depth_and_colour(tmp_path, channels, dtype):
    path = tmp_path / "a.png"
    largest = np.iinfo(dtype).max
    codes = np.random.default_rng(0).integers(0, largest + 1, (11, 7, channels), dtype)
    path.write_bytes(png(codes))
    image = io.read_png(path)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, linear(codes, largest), rtol=3e-7)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_every_code_comes_back(tmp_path, channels):
    codes = np.arange(256 * channels).reshape(16, 16, channels) % 256
    path = tmp_path / "a.png"
    io.write_png(path, linear(codes, 255))
    with Image.open(path) as picture:
        np.testing.assert_array_equal(np.asarray(picture).reshape(codes.shape), codes)
    once = io.read_png(path)
    np.testing.assert_allclose(once, linear(codes, 255), rtol=3e-7)
    before = path.read_bytes()
    io.write_png(path, once)
    assert path.read_bytes() == before


def test_write_clips_and_rounds(tmp_path):
    """Values are rounded to the nearest code and clipped; nothing wraps around."""
    half = linear(np.array([[[100.49], [100.51]]]), 255)
    bad = np.array([[[-1.0], [7.0], [np.inf], [-np.inf], [np.nan]]])
    io.write_png(tmp_path / "a.png", np.concatenate([half, bad], axis=1))
    with Image.open(tmp_path / "a.png") as picture:
        assert np.asarray(picture).tolist() == [[100, 101, 0, 255, 255, 0, 0]]


def test_alpha_is_linear(tmp_path):
    io.write_png(tmp_path / "a.png", np.full((1, 1, 4), 0.5, np.float32))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.getpixel((0, 0)) == (188, 188, 188, 128)


def test_palettes_and_single_bits(tmp_path):
    path = tmp_path / "a.png"
    codes = np.array([[[0, 10, 200], [255, 0, 3]]], np.uint8)
    picture = Image.fromarray(codes).quantize(4)
    picture.save(path)
    np.testing.assert_allclose(io.read_png(path), linear(codes, 255), rtol=3e-7)
    picture.save(path, transparency=bytes([0, 128, 255, 255]))
    image = io.read_png(path)
    assert image.shape == (1, 2, 4)
    np.testing.assert_allclose(image[..., :3], linear(codes, 255), rtol=3e-7)
    Image.fromarray(np.array([[True, False]])).save(path)
    np.testing.assert_array_equal(io.read_png(path), [[[1], [0]]])


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_transparent_colour_has_alpha_0(tmp_path, channels, dtype):
    codes = np.random.default_rng(0).integers(0, 255, (5, 6, channels)).astype(dtype)
    codes[2, 3] = codes[4, 1]
    key = codes[2, 3].astype(">u2").tobytes()
    (tmp_path / "a.png").write_bytes(png(codes, chunk(b"tRNS", key)))
    image = io.read_png(tmp_path / "a.png")
    alpha = np.any(codes != codes[2, 3], axis=2)
    assert not alpha[4, 1]
    np.testing.assert_array_equal(image[..., channels], alpha)
    expected = linear(codes, np.iinfo(dtype).max)
    np.testing.assert_allclose(image[..., :channels], expected, rtol=3e-7)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_a_transparent_grey_of_few_bits(tmp_path, bits):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 8 // bits, 1, bits, 0, 0, 0, 0))
    row = chunk(b"IDAT", zlib.compress(b"\0" + bytes([0b01001110])))
    values = np.array([[[0b01001110 >> at & 2**bits - 1] for at in range(8 - bits, -1, -bits)]])
    key = chunk(b"tRNS", struct.pack(">H", values[0, 0, 0]))
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + header + key + row + chunk(b"IEND", b"")
    )
    image = io.read_png(tmp_path / "a.png")
    np.testing.assert_array_equal(image[..., 1:], values != values[0, 0, 0])
    np.testing.assert_allclose(image[..., :1], linear(values, 2**bits - 1), rtol=3e-7)


@pytest.mark.parametrize("gamma", [1.0, 0.55, 1 / 2.2])
def test_the_gamma_that_the_file_names(tmp_path, gamma):
    """A gamma of 1 is linear; that of sRGB means sRGB's curve, which is no power."""
    codes = np.arange(256, dtype=np.uint8).reshape(8, 8, 4)
    fact = chunk(b"gAMA", struct.pack(">I", round(1e5 * gamma)))
    (tmp_path / "a.png").write_bytes(png(codes, fact))
    curved = codes[..., :3] / 255
    is_srgb = gamma == 1 / 2.2
    expected = linear(codes, 255)[..., :3] if is_srgb else curved ** (1 / gamma)
    image = io.read_png(tmp_path / "a.png")
    np.testing.assert_allclose(image[..., :3], expected, rtol=1e-6)
    np.testing.assert_allclose(image[..., 3], codes[..., 3] / 255, rtol=1e-6)
    (tmp_path / "a.png").write_bytes(png(codes, fact + chunk(b"sRGB", b"\0")))
    assert_srgb = io.read_png(tmp_path / "a.png")
    np.testing.assert_allclose(assert_srgb, linear(codes, 255), rtol=3e-7)


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`write_png\(path\)` must end in `.png`.*a.jpg`"):
        io.write_png(tmp_path / "a.jpg", np.zeros((4, 5, 3)))
    assert not list(tmp_path.iterdir())


def test_write_takes_any_layout(tmp_path):
    image = np.random.default_rng(0).random((6, 5, 3))
    io.write_png(tmp_path / "a.png", image)
    io.write_png(tmp_path / "b.png", np.asfortranarray(image)[::-1].copy()[::-1])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("shape", [(4, 5), (0, 5, 3), (4, 5, 0), (4, 5, 5)])
def test_errors_of_shape(tmp_path, shape):
    with pytest.raises(ValueError, match=r"`write_png\(image\)` must hold floats of shape"):
        inspect.unwrap(io.write_png)(tmp_path / "a.png", np.zeros(shape))
    assert not list(tmp_path.iterdir())


def test_errors_of_type_and_folder(tmp_path):
    with pytest.raises(ValueError, match=r"`write_png\(image\)` must hold floats .* got uint8"):
        inspect.unwrap(io.write_png)(tmp_path / "a.png", np.zeros((4, 5, 3), np.uint8))
    with pytest.raises(ValueError, match=r"`write_png\(image\)` must .* got a masked array"):
        inspect.unwrap(io.write_png)(tmp_path / "a.png", np.ma.zeros((4, 5, 3)))
    with pytest.raises(FileNotFoundError, match=r"cannot write `a.png` here"):
        io.write_png(tmp_path / "no" / "a.png", np.zeros((4, 5, 3)))


def test_files_that_are_not_png(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(FileNotFoundError):
        io.read_png(path)
    path.touch()
    with pytest.raises(ValueError, match=r"a.png` is damaged or not PNG"):
        io.read_png(path)
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(path, "JPEG")
    with pytest.raises(ValueError, match=r"a.png` is damaged or not PNG"):
        io.read_png(path)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_mutated_files_raise_or_keep_their_shape(tmp_path, dtype):
    rng = np.random.default_rng(0)
    codes = rng.integers(0, np.iinfo(dtype).max + 1, (20, 15, 3), dtype)
    path, data = tmp_path / "a.png", png(codes)
    raised = 0
    for i in range(80):
        at = rng.integers(len(data))
        flipped = data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]
        path.write_bytes(data[:at] if i % 2 else flipped)
        try:
            image = io.read_png(path)
        except ValueError as error:
            assert str(path) in str(error)
            raised += 1
        else:
            assert image.shape == (20, 15, 3)
    assert raised > 60
