"""G-buffers in EXR files: read by this package, OpenImageIO and Blender; Nuke's names."""

import pathlib
import re
import shutil
import subprocess

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from scipy.spatial.transform import Rotation

from jaxfx import GBuffer, OrthographicCamera, PinholeCamera, exr


PASSES = ("color", "shader", "ambient", "diffuse", "specular", "normal", "depth", "roughness")


def gbuffer(dtype=np.float32, height=5, width=7):
    rng = np.random.default_rng(0)
    images = {name: rng.normal(size=(height, width, 3)).astype(dtype) for name in PASSES}
    depth = rng.uniform(1, 9, (height, width)).astype(dtype)
    depth[0] = np.inf
    flat = {
        "shader": rng.integers(-1, 3, (height, width), np.int32),
        "depth": depth,
        "roughness": rng.random((height, width)).astype(dtype),
    }
    return GBuffer(**images | flat)


def camera(kind, dtype):
    """A camera whose numbers have no short decimal form."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    pose[:3, 3] = 1 / 3, -np.pi, np.e
    if kind is PinholeCamera:
        intrinsics = np.array([[500 / 3, 0.1, 7 / 3], [0, 510 / 7, 22 / 9], [0, 0, 1]])
        return PinholeCamera(intrinsics.astype(dtype), pose.astype(dtype))
    centre = np.array([1.1, -2.2], dtype)
    return OrthographicCamera(np.array(3.3, dtype), centre, pose.astype(dtype))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_round_trip(tmp_path, dtype):
    before = gbuffer(dtype)
    exr.write_gbuffer(tmp_path / "a.exr", before)
    after, none = exr.read_gbuffer(tmp_path / "a.exr")
    assert none is None
    assert eqx.tree_equal(before, after, typematch=True)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", [PinholeCamera, OrthographicCamera])
def test_the_camera_is_kept_exactly(tmp_path, kind, dtype):
    before = camera(kind, dtype)
    exr.write_gbuffer(tmp_path / "a.exr", gbuffer(), camera=before)
    cache = exr.read_gbuffer(tmp_path / "a.exr")
    assert cache._fields == ("gbuffer", "camera")
    assert eqx.tree_equal(before, cache.camera, typematch=True)


def test_double_precision_is_rounded(tmp_path):
    before = gbuffer(np.float64)
    exr.write_gbuffer(tmp_path / "a.exr", before)
    after, _ = exr.read_gbuffer(tmp_path / "a.exr")
    for name in PASSES:
        single = getattr(before, name)
        if name != "shader":
            single = single.astype(jnp.float32)
        assert getattr(after, name).dtype == single.dtype
        np.testing.assert_array_equal(getattr(after, name), single)


def test_the_passes_are_layers(tmp_path):
    before = gbuffer()
    exr.write_gbuffer(tmp_path / "a.exr", before)
    layers = exr.read(tmp_path / "a.exr")
    assert layers.keys() == set(PASSES)
    for name, layer in layers.items():
        np.testing.assert_array_equal(layer, getattr(before, name))
    header = OpenEXR.File(str(tmp_path / "a.exr"), header_only=True).header()
    names = {channel.name for channel in header["channels"]}
    colors = {
        f"{name}.{c}" for name in ("color", "ambient", "diffuse", "specular") for c in "RGB"
    }
    flat = {"normal.X", "normal.Y", "normal.Z", "depth.Z", "shader.V", "roughness.V"}
    assert names == colors | flat


@pytest.fixture
def file(tmp_path):
    """A deep frame buffer and the file that holds it."""
    path, before = tmp_path / "a.exr", gbuffer()
    exr.write_gbuffer(path, before, camera=camera(PinholeCamera, np.float32))
    return before, path


def test_open_image_io_finds_the_passes(file):
    """The library by which many programs read EXR files."""
    before, path = file
    found = OpenImageIO.ImageInput.open(str(path))
    names, pixels = found.spec().channelnames, found.read_image("float")
    for name in PASSES:
        own = [i for i, channel in enumerate(names) if channel.startswith(f"{name}.")]
        # Red before green before blue, as X before Y before Z, whatever the order on disk.
        assert [names[i][-1] for i in own] in (["R", "G", "B"], ["X", "Y", "Z"], ["Z"], ["V"])
        layer = np.asarray(getattr(before, name)).reshape(5, 7, -1)
        np.testing.assert_array_equal(pixels[..., own], layer)
    kept = np.reshape(found.spec().getattribute("jaxfx.world_from_camera"), (4, 4))
    np.testing.assert_array_equal(kept, camera(PinholeCamera, np.float32).world_from_camera)


def test_blender_finds_the_passes(file, tmp_path):
    """Blender's compositor has each pass under its name, with every bit of its numbers."""
    blender = shutil.which("blender")
    if blender is None:
        pytest.skip("Blender is not installed, e.g. by apt-get install blender")
    before, path = file
    script, folder = pathlib.Path(__file__).with_name("blender_passes.py"), tmp_path / "passes"
    options = ["--background", "--factory-startup", "--python-exit-code", "1"]
    command = [blender, *options, "--python", script, "--", path, folder]
    subprocess.run(command, check=True, timeout=100, capture_output=True)
    found = {re.sub(r"\d*\.exr$", "", file.name): file for file in folder.iterdir()}
    assert found.keys() == set(PASSES)
    for name in PASSES:
        saved = OpenEXR.File(str(found[name]), separate_channels=True).channels()
        layer = np.asarray(getattr(before, name), np.float32).reshape(5, 7, -1)
        for letter, plane in zip("RGB", np.moveaxis(layer, -1, 0), strict=False):
            np.testing.assert_array_equal(saved[letter].pixels, plane)


def nuke_name(channel):
    """Nuke's name for a channel of an EXR file, by the source of its reader.

    Foundry publishes that source with its development kit. The name is cut at its first two
    dots. Leading digits and empty parts go, and what is no letter or digit becomes `_`. The
    last part is the channel, r, g, b and a spelt out; the others are its layer, where `Ci` is
    the main image's.
    """
    parts = [re.sub(r"^[0-9]+", "", part) for part in channel.split(".", 2)]
    *layers, last = [re.sub("[^a-zA-Z0-9]", "_", part) for part in parts if part] or ["unnamed"]
    for word in ("red", "green", "blue", "alpha"):
        if last in (word[0], word[0].upper(), word.title(), word.upper()):
            last = word
    layer = "_".join(layers)
    return last if layer in ("", "Ci") else f"{layer}.{last}"


@pytest.mark.parametrize(
    ("channel", "name"),
    [  # Printed by that source, compiled.
        ("R", "red"),
        ("2.0a.B", "a.blue"),
        ("Ci.g", "green"),
        ("View Layer.AO pass.r.x", "View_Layer_AO_pass.r_x"),
        ("left..ALPHA", "left.alpha"),
        (".", "unnamed"),
        ("a.bLue", "a.bLue"),
        ("7.8", "unnamed"),
    ],
)
def test_the_rule_of_nuke(channel, name):
    assert nuke_name(channel) == name


def test_nuke_finds_the_passes(file):
    """Nuke finds each layer under its name; it needs one data window, all of it displayed."""
    header = OpenEXR.File(str(file[1]), header_only=True).header()
    found = {nuke_name(channel.name) for channel in header["channels"]}
    colors = ("color", "ambient", "diffuse", "specular")
    named = {f"{name}.{word}" for name in colors for word in ("red", "green", "blue")}
    vector = {"normal.X", "normal.Y", "normal.Z"}
    # Nuke keeps `depth.Z` for depth itself.
    assert found == named | vector | {"depth.Z", "shader.V", "roughness.V"}
    np.testing.assert_array_equal(header["dataWindow"], header["displayWindow"])
    assert header["type"] == OpenEXR.scanlineimage and header["pixelAspectRatio"] == 1.0


def layers_of(buffer):
    return {name: np.asarray(getattr(buffer, name)) for name in PASSES}


def test_other_layers_are_let_be(tmp_path):
    before = gbuffer()
    exr.write(tmp_path / "a.exr", layers_of(before) | {"": before.color, "x": before.depth})
    after, _ = exr.read_gbuffer(tmp_path / "a.exr")
    assert eqx.tree_equal(before, after, typematch=True)


@pytest.mark.parametrize("name", PASSES)
def test_a_missing_pass_is_named(tmp_path, name):
    layers = layers_of(gbuffer())
    del layers[name]
    exr.write(tmp_path / "a.exr", layers)
    with pytest.raises(ValueError, match=rf"a.exr` must have the layer `{name}`, got \["):
        exr.read_gbuffer(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("name", "layer", "message"),
    [
        ("shader", np.full((5, 7), 0.5), "must have whole numbers in the layer `shader`"),
        ("shader", np.full((5, 7), np.nan), "must have whole numbers in the layer `shader`"),
        ("shader", np.zeros((5, 7, 3)), r"`GBuffer\(shader\)` must hold integers of shape"),
        ("depth", np.ones((5, 7, 1)), r"`GBuffer\(depth\)` must have shape \(5, 7\)"),
        ("color", np.ones((5, 7)), r"`GBuffer\(color\)` must have shape"),
    ],
)
def test_a_pass_that_does_not_fit_is_named(tmp_path, name, layer, message):
    exr.write(tmp_path / "a.exr", layers_of(gbuffer()) | {name: layer})
    with pytest.raises(ValueError, match=rf"a.exr` .*{message}"):
        exr.read_gbuffer(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"PinholeCamera", b"FisheyeCamera", "must be one of the two cameras, got 'Fisheye"),
        (b"jaxfx.intrinsics", b"jaxfx.Intrinsics", "'jaxfx.intrinsics'"),
        (b"jaxfx.camera\0string", b"jaxfx.camera\0strung", "must be one of the two cameras"),
    ],
)
def test_a_damaged_camera(tmp_path, old, new, message):
    path = tmp_path / "a.exr"
    exr.write_gbuffer(path, gbuffer(), camera=camera(PinholeCamera, np.float32))
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    with pytest.raises(ValueError, match=r"a.exr` is damaged: its checksum does not fit"):
        exr.read_gbuffer(path)
    with pytest.raises(ValueError, match=rf"a.exr` must hold a deep frame buffer: .*{message}"):
        exr.read_gbuffer(path, verify=False)


def test_the_passes_of_another_program(tmp_path):
    """Without the package's attributes there is no checksum to check, and no camera."""
    before = gbuffer()
    exr.write_gbuffer(tmp_path / "a.exr", before)
    planes = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: channel.pixels for name, channel in planes.items()}
    OpenEXR.File(header, pixels).write(str(tmp_path / "b.exr"))
    after, none = exr.read_gbuffer(tmp_path / "b.exr")
    assert none is None
    assert eqx.tree_equal(before, after, typematch=True)


@pytest.mark.parametrize("value", [0x01, 0x80, 0xFF])
def test_no_byte_can_change_unnoticed(tmp_path, value):
    """Every byte of the header and of the chunk table, and some of the chunks'."""
    path = tmp_path / "a.exr"
    exr.write_gbuffer(path, gbuffer(height=40), camera=camera(PinholeCamera, np.float32))
    data = bytearray(path.read_bytes())
    # A zero ends the header; eight bytes follow for each of three chunks.
    chunks = data.index(b"scanlineimage") + 14 + 24
    assert data[chunks : chunks + 4] == bytes(4)  # the first chunk's first row
    for at in [*range(chunks), *range(chunks, len(data), 37), len(data) - 1]:
        data[at] ^= value
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"a\.exr` (must be an OpenEXR file|is damaged)"):
            exr.read_gbuffer(path)
        data[at] ^= value
    path.write_bytes(data)
    exr.read_gbuffer(path)


def test_no_cut_goes_unnoticed(tmp_path):
    path = tmp_path / "a.exr"
    exr.write_gbuffer(path, gbuffer(), camera=camera(PinholeCamera, np.float32))
    data = path.read_bytes()
    for end in range(len(data)):
        path.write_bytes(data[:end])
        with pytest.raises(ValueError, match=r"a\.exr` (must be an OpenEXR file|is damaged)"):
            exr.read_gbuffer(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(ValueError, match=r"a\.exr` is damaged: "):
        exr.read_gbuffer(path)


def test_max_pixels(tmp_path):
    exr.write_gbuffer(tmp_path / "a.exr", gbuffer())
    with pytest.raises(ValueError, match="at most `max_pixels=34`, got 7 x 5"):
        exr.read_gbuffer(tmp_path / "a.exr", max_pixels=34)
