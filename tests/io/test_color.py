"""Images from PNG, JPEG and EXR files, recognised by their first bytes."""

import io as streams

import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms, ImageOps

from jaxfx import exr, io


FLAT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def codes(size=(24, 40), channels=3):
    """A smooth 8-bit image with different colours in all corners."""
    y, x = np.mgrid[: size[0], : size[1]]
    planes = [20 + 4 * x, 200 - 3 * y, 40 + 2 * x + 2 * y, 255 - x]
    return np.stack(planes[:channels], axis=-1).astype(np.uint8)


def linear(stored):
    values = stored / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def jpeg(path, picture, **options):
    picture.save(path, "JPEG", quality=100, subsampling=0, **options)
    with Image.open(path) as decoded:
        return np.asarray(decoded)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a"])
@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_by_its_content(tmp_path, name, channels):
    stored = codes(channels=channels)
    path = tmp_path / name
    decoded = jpeg(path, Image.fromarray(stored[..., 0] if channels == 1 else stored))
    image = io.read_color(path)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, linear(decoded).reshape(24, 40, channels), rtol=1e-5)
    np.testing.assert_allclose(image, linear(stored), atol=0.02)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_are_turned_upright(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.jpg"
    jpeg(path, Image.fromarray(codes()), exif=exif)
    with Image.open(path) as picture:
        expected = np.asarray(ImageOps.exif_transpose(picture))
    np.testing.assert_allclose(io.read_color(path), linear(expected), rtol=1e-5)


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_a_profile_that_is_not_heeded_is_logged(tmp_path, caplog, kind):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile, count in ((srgb, 0), (srgb.replace(b"s\0R\0G\0B", b"w\0i\0d\0e"), 1)):
        assert (profile == srgb) == (count == 0)
        Image.fromarray(codes()).save(tmp_path / "a", kind, icc_profile=profile)
        io.read_color(tmp_path / "a")
        assert len(caplog.records) == count
    assert "a colour profile that is not applied" in caplog.text


def test_png_and_exr_under_any_name(tmp_path):
    image = linear(codes()).astype(np.float32)
    io.write_png(tmp_path / "a.png", image)
    exr.write(tmp_path / "a.exr", image)
    for name in ("a.png", "a.exr"):
        (tmp_path / name).rename(tmp_path / "b.jpg")
        np.testing.assert_allclose(io.read_color(tmp_path / "b.jpg"), image, rtol=1e-5)


def test_a_layer_of_an_exr_file(tmp_path):
    path = tmp_path / "a.exr"
    planes = {
        f"{layer}.Combined.{letter}": np.full((2, 3), i + j, np.float16)
        for i, layer in enumerate(["Front", "Back"])
        for j, letter in enumerate("RGBA")
    }
    OpenEXR.File(FLAT.copy(), planes).write(str(path))
    with pytest.raises(ValueError, match=r"must have one layer .*\['Back', 'Front'\]"):
        io.read_color(path)
    with pytest.raises(ValueError, match=r"must have a layer `Up` .*\['Back', 'Front'\]"):
        io.read_color(path, layer="Up")
    image = io.read_color(path, layer="Back")
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image[1, 2], [1, 2, 3, 4])


def test_passes_of_light_are_not_taken_for_the_image(tmp_path):
    path, image = tmp_path / "a.exr", np.ones((2, 3, 3), np.float32)
    exr.write(path, {"ViewLayer.DiffCol": image, "ViewLayer.Combined": 2 * image})
    np.testing.assert_array_equal(io.read_color(path), 2 * image)
    exr.write(path, {"DiffCol": image, "": 2 * image})
    np.testing.assert_array_equal(io.read_color(path), 2 * image)
    exr.write(path, {"DiffCol": image, "GlossCol": 2 * image})
    with pytest.raises(ValueError, match=r"must have one layer with an image"):
        io.read_color(path)


def test_errors(tmp_path):
    path = tmp_path / "a.jpg"
    with pytest.raises(FileNotFoundError):
        io.read_color(path)
    path.touch()
    with pytest.raises(ValueError, match=r"a.jpg` must be a PNG, .* an empty one"):
        io.read_color(path)
    path.write_bytes(b"GIF89a")
    with pytest.raises(ValueError, match=r"a.jpg` must be .* begins with b'GIF8'"):
        io.read_color(path)
    Image.fromarray(codes(channels=4), "CMYK").save(path, "JPEG")
    with pytest.raises(ValueError, match=r"a.jpg` is damaged or not a JPEG .* got CMYK"):
        io.read_color(path)
    jpeg(path, Image.fromarray(codes()))
    with pytest.raises(ValueError, match=r"a.jpg` must be an EXR file to have a layer `x`"):
        io.read_color(path, layer="x")
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(ValueError, match=r"a.jpg` is damaged"):
        io.read_color(path)


def test_mutated_files_raise_or_keep_their_shape(tmp_path):
    rng, stream = np.random.default_rng(0), streams.BytesIO()
    Image.fromarray(codes()).save(stream, "JPEG")
    data, path = stream.getvalue(), tmp_path / "a.jpg"
    for i in range(60):
        at = rng.integers(3, len(data))
        flipped = data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]
        path.write_bytes(data[:at] if i % 2 else flipped)
        try:
            image = io.read_color(path)
        except ValueError as error:
            assert str(path) in str(error)
        else:
            assert image.ndim == 3
            assert i % 2 == 0
