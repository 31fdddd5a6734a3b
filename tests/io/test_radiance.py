"""Radiance pictures, against an encoder of our own and numbers from the format's definition."""

import math

import numpy as np
import pytest

from jaxfx import io


HEADER = b"#?RADIANCE\nSOFTWARE=none\nFORMAT=32-bit_rle_rgbe\n\n"


def texel(color):
    """Mantissas and exponent of one pixel: the definition, number by number."""
    largest = max(color)
    if largest < 1e-32:
        return [0, 0, 0, 0]
    exponent = math.frexp(largest)[1]
    return [int(math.ldexp(value, 8 - exponent)) for value in color] + [exponent + 128]


def encoded(texels, is_coded):
    height, width = texels.shape[:2]
    body = f"-Y {height} +X {width}\n".encode()
    if not is_coded:
        return body + texels.tobytes()
    for row in texels:
        body += bytes([2, 2, width >> 8, width & 255])
        for channel in row.T:
            # A run where the row begins with three equal numbers, then what is left as it is.
            run = len(channel) if len(set(channel)) == 1 else 0
            rest = channel[run:]
            body += bytes([128 + run, channel[0]]) if run else b""
            body += bytes([len(rest), *rest]) if len(rest) else b""
    return body


@pytest.fixture
def radiance():
    image = np.random.default_rng(0).lognormal(0, 4, (6, 20, 3))
    image[2] = image[2, 0]
    image[4, 3] = 0
    return image


@pytest.mark.parametrize("is_coded", [False, True])
def test_values_are_those_of_the_definition(tmp_path, radiance, is_coded):
    texels = np.array([[texel(color) for color in row] for row in radiance], np.uint8)
    path = tmp_path / "sky.png"
    path.write_bytes(HEADER + encoded(texels, is_coded))
    image = io.read_color(path)
    assert image.dtype == np.float32
    step = 2.0 ** (texels[..., 3:].astype(float) - 136)
    assert np.all(np.abs(image - radiance) <= np.where(texels[..., 3:] > 0, 0.51 * step, 0))
    assert not image[4, 3].any()


def test_one_pixel_by_hand(tmp_path):
    path = tmp_path / "a.hdr"
    header = HEADER.replace(b"\n\n", b"\nEXPOSURE=2\nEXPOSURE= 0.25\n\n")
    path.write_bytes(header + b"-Y 1 +X 1\n" + bytes([128, 64, 0, 129]))
    # 2**(129 - 136) is 1 / 128; the exposures' product is 0.5.
    np.testing.assert_allclose(io.read_color(path), [[[128.5 / 64, 64.5 / 64, 0.5 / 64]]])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (HEADER + b"+X 2 -Y 2\n" + bytes(16), "whose size is `-Y height"),
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 2 +X 2\n" + bytes(16), "32-bit_rle_rgbe"),
        (HEADER + b"-Y 2 +X 2\n" + bytes(15), "damaged: 15 bytes for 2 x 2"),
        (HEADER + b"-Y 1 +X 2\n" + bytes([9, 9, 9, 9, 1, 1, 1, 4]), "first version"),
        (HEADER + b"-Y 1 +X 9\n" + bytes([2, 2, 0, 9, 130, 7]), "damaged"),
        (HEADER + b"-Y 1 +X 9\n" + bytes([2, 2, 0, 9, 138, 7]), "ends early or is too long"),
        (HEADER + b"-Y 99999999999 +X 9\n" + bytes([2, 2, 0, 9]), "damaged: 4 bytes for 9999"),
        (HEADER + b"-Y 0 +X 9\n", "must have pixels"),
        (b"#?RADIANCE\n", "must be a Radiance picture"),
    ],
)
def test_errors_name_the_file(tmp_path, data, message):
    path = tmp_path / "bad.hdr"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message) as caught:
        io.read_color(path)
    assert str(path) in str(caught.value)


def test_mutated_files_raise_or_keep_their_shape(tmp_path, radiance):
    texels = np.array([[texel(color) for color in row] for row in radiance], np.uint8)
    rng, path = np.random.default_rng(0), tmp_path / "a.hdr"
    data = HEADER + encoded(texels, True)
    for i in range(200):
        at = rng.integers(11, len(data))
        flipped = data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]
        path.write_bytes(data[:at] if i % 2 else flipped)
        try:
            image = io.read_color(path)
        except ValueError as error:
            assert str(path) in str(error)
        else:
            assert image.ndim == 3
            assert i % 2 == 0
