"""Each kind of EXR file of the standard: read correctly, or refused with its name."""

import io
import struct
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from jaxfx import exr


FLAT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
TILED = FLAT | {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
LOSSLESS = ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "ZSTD", "HTJ2K32", "HTJ2K256"]
LOSSY = ["PXR24", "B44", "B44A", "DWAA", "DWAB"]


def smooth(dtype=np.float32, size=(37, 53)):
    """A ramp in both directions, smooth enough for lossy compression."""
    y, x = np.mgrid[: size[0], : size[1]]
    return (0.2 + 0.01 * x + 0.005 * y).astype(dtype)


def write(path, channels, header=FLAT, **more):
    OpenEXR.File(header | more, dict(channels)).write(str(path))


def assert_layers(found, expected):
    assert found.keys() == expected.keys()
    for name, layer in expected.items():
        assert found[name].dtype == layer.dtype
        np.testing.assert_array_equal(found[name], layer)


@pytest.mark.parametrize("header", [FLAT, TILED], ids=["lines", "tiles"])
@pytest.mark.parametrize("compression", LOSSLESS)
def test_lossless_compressions(tmp_path, compression, header):
    """Halves, floats and integers in one file."""
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    layers = {
        "h": smooth(np.float16),
        "f": smooth(np.float32),
        "u": (1000 * smooth()).astype(np.uint32),
    }
    planes = {f"{name}.V": plane for name, plane in layers.items()}
    write(tmp_path / "a.exr", planes, header, compression=kind)
    assert_layers(exr.read(tmp_path / "a.exr"), layers)


@pytest.mark.parametrize("header", [FLAT, TILED], ids=["lines", "tiles"])
@pytest.mark.parametrize("compression", LOSSY)
def test_lossy_compressions(tmp_path, compression, header):
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    write(
        tmp_path / "a.exr", dict.fromkeys("RGB", smooth(np.float16)), header, compression=kind
    )
    found = exr.read(tmp_path / "a.exr")[""]
    np.testing.assert_allclose(found, np.stack([smooth()] * 3, axis=-1), rtol=0.02)


def test_every_compression_is_tried():
    known = {name for name in dir(OpenEXR.Compression) if name.endswith("_COMPRESSION")}
    tried = {f"{name}_COMPRESSION" for name in LOSSLESS + LOSSY}
    assert known - tried <= {
        "LJ2K_COMPRESSION"
    }  # The library has the name, and no code for it.


def test_of_many_levels_the_finest(tmp_path):
    path = str(tmp_path / "a.exr")
    image = np.stack([smooth(size=(32, 64))] * 3, axis=-1)
    options = OpenImageIO.ImageSpec()
    options.tile_width = options.tile_height = 16
    OpenImageIO.ImageBufAlgo.make_texture(
        OpenImageIO.MakeTxTexture, OpenImageIO.ImageBuf(image), path, options
    )
    assert OpenImageIO.ImageBuf(path).nmiplevels > 1
    assert_layers(exr.read(path), {"": image})


@pytest.mark.parametrize("order", ["INCREASING_Y", "DECREASING_Y"])
def test_rows_in_either_order(tmp_path, order):
    write(tmp_path / "a.exr", {"Y": smooth()}, lineOrder=getattr(OpenEXR, order))
    np.testing.assert_array_equal(exr.read(tmp_path / "a.exr")[""][..., 0], smooth())


@pytest.mark.parametrize("corner", [(-7, -5), (0, 0), (30, 40)])
def test_a_data_window_within_around_and_beside_the_display(tmp_path, corner):
    left, top = corner
    data = (np.array([left, top], np.int32), np.array([left + 52, top + 36], np.int32))
    display = (np.zeros(2, np.int32), np.array([45, 29], np.int32))
    write(tmp_path / "a.exr", {"Y": smooth()}, dataWindow=data, displayWindow=display)
    np.testing.assert_array_equal(exr.read(tmp_path / "a.exr")[""][..., 0], smooth())


def test_long_names(tmp_path):
    """Names longer than 31 bytes, which older versions of the format do not allow."""
    name = "a very long layer name, of 200 bytes ".ljust(200, "_")
    write(tmp_path / "a.exr", {f"{name}.V": smooth()})
    assert_layers(exr.read(tmp_path / "a.exr"), {name: smooth()})


def test_views_in_one_part(tmp_path):
    names = ["R", "G", "B", "right.R", "right.G", "right.B", "Z", "depth.right.Z"]
    planes = {name: smooth() + i for i, name in enumerate(names)}
    write(tmp_path / "a.exr", planes, multiView=["left", "right"])
    layers = exr.read(tmp_path / "a.exr")
    assert layers.keys() == {"", "right", "Z", "depth.right"}
    np.testing.assert_array_equal(layers["right"][..., 0], smooth() + 3)


def part(name, header=FLAT, size=(37, 53), view=None, **planes):
    """A part whose values are offset by a number; all parts share one display window."""
    display = (np.zeros(2, np.int32), np.array([52, 36], np.int32))
    named = {channel.replace("_", "."): smooth(size=size) + v for channel, v in planes.items()}
    seen = {} if view is None else {"view": view}
    return OpenEXR.Part(header | seen | {"displayWindow": display}, named, name)


@pytest.mark.parametrize("views", [("left", "right"), (None, None), ("left", "left")])
def test_parts_that_share_names(tmp_path, views):
    """Two parts with the same passes, told apart by their views, or else by their names."""
    OpenEXR.File(
        [
            part("one", view=views[0], R=0, G=1, B=2, depth_Z=3, only_V=4),
            part("two", view=views[1], R=5, G=6, B=7, depth_Z=8, other_V=9),
        ]
    ).write(str(tmp_path / "a.exr"))
    layers = exr.read(tmp_path / "a.exr")
    depths = ["depth.left", "depth.right"] if views[1] == "right" else ["depth", "two.depth"]
    assert layers.keys() == {"", "only", "two", "other", *depths}
    flat = {name: layer for name, layer in layers.items() if layer.ndim == 2}
    expected = {depths[0]: 3, "only": 4, depths[1]: 8, "other": 9}
    assert_layers(flat, {name: smooth() + value for name, value in expected.items()})
    np.testing.assert_array_equal(
        layers["two"], np.stack([smooth() + i for i in (5, 6, 7)], -1)
    )


@pytest.mark.parametrize("is_seen", [True, False])
def test_a_part_for_each_pass(tmp_path, is_seen):
    """As in the official multi-part images: names with a dot, in two of the later parts."""
    left, right = ("left", "right") if is_seen else (None, None)
    OpenEXR.File(
        [
            part("rgba_right", view=right, R=0, G=1, B=2, A=3),
            part("depth_left", view=left, Z=4),
            part("forward_left", view=left, forward_u=5, forward_v=6),
            part("mask_left", view=left, mask_mask=7, size=(20, 10)),
            part("forward_right", view=right, forward_u=8, forward_v=9),
            part("rgba_left", TILED, view=left, R=10, G=11, B=12, A=13),
        ]
    ).write(str(tmp_path / "a.exr"))
    layers = exr.read(tmp_path / "a.exr")
    names = [
        f"forward.{side}.{axis}" if is_seen else f"forward_{side}.forward.{axis}"
        for side in ("left", "right")
        for axis in "uv"
    ]
    assert layers.keys() == {"", "depth_left", "rgba_left", "mask.mask", *names}
    for value, name in zip((5, 6, 8, 9), names, strict=True):
        np.testing.assert_array_equal(layers[name], smooth() + value)
    assert layers["mask.mask"].shape == (20, 10)
    assert layers["rgba_left"].shape == (37, 53, 4)


def test_a_layer_over_parts_of_two_sizes(tmp_path):
    OpenEXR.File([part("a", v_X=0, v_Y=1), part("b", v_Z=2, size=(9, 8))]).write(
        str(tmp_path / "a.exr")
    )
    layers = exr.read(tmp_path / "a.exr")
    assert {name: layer.shape for name, layer in layers.items()} == {
        **{"v.X": (37, 53), "v.Y": (37, 53)},
        "v.Z": (9, 8),
    }


def test_one_name_twice_is_refused(tmp_path):
    OpenEXR.File([part("x", a_b_V=0), part("a", b_V=1), part("c", b_V=2)]).write(
        str(tmp_path / "a.exr")
    )
    with pytest.raises(ValueError, match=r"a.exr` must name its channels .* `a.b.V` twice"):
        exr.read(tmp_path / "a.exr")


def samples():
    pixels = np.empty((2, 3), object)
    for i in np.ndindex(2, 3):
        pixels[i] = np.ones(2, np.float32)
    return pixels


@pytest.mark.parametrize("kind", ["deepscanline", "deeptile"])
@pytest.mark.parametrize("is_first", [True, False])
def test_deep_pixels_are_refused(tmp_path, kind, is_first):
    flat = part("flat", Y=0, size=(2, 3))
    header = flat.header | TILED | {"compression": OpenEXR.ZIPS_COMPRESSION}
    deep = OpenEXR.Part(header | {"type": getattr(OpenEXR, kind)}, {"Z": samples()}, "deep")
    OpenEXR.File([deep, flat] if is_first else [flat, deep]).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a.exr` must hold flat pixels, got deep ones"):
        exr.read(tmp_path / "a.exr")


def test_luminance_and_alpha_are_kept_apart(tmp_path):
    write(tmp_path / "a.exr", {"Y": smooth(), "A": smooth()})
    layers = exr.read(tmp_path / "a.exr")
    assert_layers(layers, {"Y": smooth(), "A": smooth()})


def test_attributes_of_many_types(tmp_path):
    attributes = {
        "comment": "größer",
        "envmap": OpenEXR.ENVMAP_LATLONG,
        "screen": [0.5, 1.5],
        "views": ["a", "b"],
        "pose": np.eye(4, dtype=np.float32),
        "code": OpenEXR.TimeCode(),
    }
    write(tmp_path / "a.exr", {"Y": smooth()}, **attributes)
    assert exr.read(tmp_path / "a.exr").keys() == {""}


def test_what_openexr_does_not_read_is_not_called_damaged_alone(tmp_path):
    """A comment in Latin-1: legal, and refused by the library."""
    path = tmp_path / "a.exr"
    write(path, {"Y": smooth()}, comment="grosser")
    path.write_bytes(path.read_bytes().replace(b"grosser", b"gr\xf6\xdfer "))
    with pytest.raises(
        ValueError, match=r"a.exr` is damaged, or not what OpenEXR reads: .*utf-8"
    ):
        exr.read(path)


def test_reading_in_threads_takes_no_print_from_others(tmp_path):
    """Twenty threads read good and damaged files while four others print."""
    path, damaged = tmp_path / "a.exr", tmp_path / "b.exr"
    exr.write(path, np.random.default_rng(0).random((60, 80, 3), np.float32))
    OpenEXR.File([part("a", x_V=0), part("b", x_V=1)]).write(str(damaged))
    data = bytearray(damaged.read_bytes())
    # A chunk: its part and first row, its size, and the zlib stream.
    start = data.rindex(struct.pack("<ii", 1, 0)) + 12
    data[start + 8 : start + 12] = b"\xff" * 4
    damaged.write_bytes(data)
    code = f"""
import concurrent.futures, sys, threading
from jaxfx import exr
stdout, done = sys.stdout, threading.Event()

def talk(name):
    count = 0
    while not done.wait(0.0002):
        sys.stdout.write(f"{{name}} {{count}}\\n")
        count += 1
    return name, count

def read(i):
    if i % 4:
        return exr.read({str(path)!r})[""].shape
    try:
        exr.read({str(damaged)!r})
    except ValueError as error:
        return str(error).partition("` ")[2]

with concurrent.futures.ThreadPoolExecutor(24) as pool:
    talkers = [pool.submit(talk, name) for name in "abcd"]
    found = set(pool.map(read, range(200)))
    done.set()
    counts = [talker.result() for talker in talkers]
assert found == {{(60, 80, 3), "is damaged: the pixels of part 1 cannot be read."}}, found
assert sys.stdout is stdout
print(dict(counts))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    *lines, last = done.stdout.splitlines()
    expected = [f"{name} {i}" for name, count in eval(last).items() for i in range(count)]
    assert len(expected) > 20
    assert sorted(lines) == sorted(expected)


def test_reading_under_a_redirect_of_others(tmp_path, monkeypatch):
    """Output of other threads is not swallowed, and no good file is refused."""
    exr.write(tmp_path / "a.exr", np.ones((60, 80, 3), np.float32))
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    done = threading.Event()

    def talk():
        count = 0
        while not done.wait(0.0002):
            print(".")
            count += 1
        return count

    with ThreadPoolExecutor(1) as pool:
        talker = pool.submit(talk)
        for _ in range(40):
            exr.read(tmp_path / "a.exr")
        done.set()
        said = talker.result()
        assert sys.stdout.getvalue() == ".\n" * said
