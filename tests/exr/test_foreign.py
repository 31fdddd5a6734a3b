"""EXR files of other programs, and damaged ones."""

import struct

import numpy as np
import OpenEXR
import pytest

from jaxfx import exr


FLAT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
IMAGE = np.zeros((3, 2, 3), np.float32)


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for key, array in expected.items():
        assert found[key].dtype == array.dtype
        assert found[key].shape == array.shape
        assert found[key].tobytes() == np.ascontiguousarray(array).tobytes()


def plane(value, size=(4, 6)):
    return np.full(size, value, np.float32)


def write_plainly(path, channels, **header):
    OpenEXR.File(FLAT | header, dict(channels)).write(str(path))


def test_loose_channels_are_layers_of_their_own(tmp_path):
    path = tmp_path / "a.exr"
    names = ["R", "G", "B", "Z", "key", "a.R", "a.Z", "b.R", "b.G", "c.X", "c.Y", "c.Z", "c.U"]
    write_plainly(path, {name: plane(i) for i, name in enumerate(names)})
    layers = exr.read(path)
    assert layers.keys() == {"", "Z", "key", "a.R", "a.Z", "b.R", "b.G", "c", "c.U"}
    np.testing.assert_array_equal(layers[""][0, 0], [0, 1, 2])
    np.testing.assert_array_equal(layers["c"][0, 0], [9, 10, 11])
    np.testing.assert_array_equal(layers["c.U"], plane(12))


def test_words_and_small_letters(tmp_path):
    path = tmp_path / "a.exr"
    names = [
        "a.red",
        "a.green",
        "a.blue",
        "a.alpha",
        "b.r",
        "b.g",
        "b.b",
        "c.R",
        "c.r",
        "c.red",
    ]
    write_plainly(path, {name: plane(i) for i, name in enumerate(names)})
    layers = exr.read(path)
    assert layers.keys() == {"a", "b", "c.R", "c.r", "c.red"}
    np.testing.assert_array_equal(layers["a"][0, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(layers["b"][0, 0], [4, 5, 6])


def test_types_of_one_layer_are_promoted(tmp_path):
    path = tmp_path / "a.exr"
    half = plane(0.1).astype(np.float16)
    write_plainly(path, {"R": half, "G": half, "B": plane(0.1)})
    expected = np.stack([half.astype(np.float32)] * 2 + [plane(0.1)], axis=-1)
    assert_same(exr.read(path), {"": expected})


def test_two_layers_of_one_name(tmp_path):
    write_plainly(tmp_path / "a.exr", {"Z": plane(0), "Z.V": plane(1)})
    with pytest.raises(ValueError, match=r"a.exr` must name its layers differently.*'Z'"):
        exr.read(tmp_path / "a.exr")


def parts(depth):
    layers = {"rgb": "RGB", "depth": "Z", "other": ["c.X", "c.Y"]}
    return [
        OpenEXR.Part(
            FLAT.copy(),
            {n: depth if n == "Z" else plane(i, depth.shape) for i, n in enumerate(names)},
            part,
        )
        for part, names in layers.items()
    ]


def test_several_parts(tmp_path):
    OpenEXR.File(parts(plane(4))).write(str(tmp_path / "a.exr"))
    layers = exr.read(tmp_path / "a.exr")
    assert layers.keys() == {"", "depth", "c"}
    np.testing.assert_array_equal(layers["depth"], plane(4))
    np.testing.assert_array_equal(layers[""][0, 0], [0, 1, 2])
    np.testing.assert_array_equal(layers["c"][0, 0], [0, 1])


def test_a_damaged_part_fails_the_file(tmp_path, capfd):
    """OpenEXR itself returns the other parts and reports the lost one on stdout."""
    path = tmp_path / "a.exr"
    OpenEXR.File(parts(np.arange(320, dtype=np.float32).reshape(16, 20))).write(str(path))
    data = bytearray(path.read_bytes())
    # A chunk: its part and first row, its size, and the zlib stream.
    start = data.rindex(struct.pack("<ii", 1, 0)) + 12
    assert data[start] == 0x78
    data[start + 8 : start + 12] = b"\xff" * 4
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a.exr` is damaged: .*part 1"):
        exr.read(path)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "PIZ", "PXR24"])
def test_other_compressions(tmp_path, compression):
    channels = {"x": np.random.default_rng(0).random((40, 33)).astype(np.float16)}
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    write_plainly(tmp_path / "a.exr", {"x.V": channels["x"]}, compression=kind)
    assert_same(exr.read(tmp_path / "a.exr"), channels)


def test_a_data_window_off_the_origin(tmp_path):
    window = (np.array([3, -2], np.int32), np.array([8, 1], np.int32))
    write_plainly(tmp_path / "a.exr", {"x.V": plane(7)}, dataWindow=window)
    assert_same(exr.read(tmp_path / "a.exr"), {"x": plane(7)})


def test_subsampled_channels_are_refused(tmp_path):
    path = tmp_path / "a.exr"
    write_plainly(path, {"BY": plane(0), "RY": plane(0), "Y": plane(0)})
    # A channel's entry: name, type, a flag, and how far apart its pixels are.
    whole, half = (b"BY\0" + struct.pack("<iiii", 2, 0, step, step) for step in (1, 2))
    path.write_bytes(path.read_bytes().replace(whole, half))
    with pytest.raises(ValueError, match=r"a.exr` must have every channel in every pixel"):
        exr.read(path)


def test_deep_pixels_are_refused(tmp_path):
    samples = np.empty((2, 3), object)
    for i in np.ndindex(2, 3):
        samples[i] = np.ones(2, np.float32)
    OpenEXR.File(
        {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}, {"Z": samples}
    ).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a.exr` must hold flat pixels, got deep ones"):
        exr.read(tmp_path / "a.exr")


def test_files_that_are_not_exr(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(FileNotFoundError):
        exr.read(path)
    path.touch()
    with pytest.raises(ValueError, match=r"a.exr` must be an OpenEXR file, got an empty one"):
        exr.read(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(ValueError, match=r"a.exr` must be .* begins with b'\\x89PNG'"):
        exr.read(path)


def test_max_pixels(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, IMAGE)
    assert_same(exr.read(path, max_pixels=6), {"": IMAGE})
    with pytest.raises(ValueError, match=r"a.exr` must have at most `max_pixels=5`, got 2 x 3"):
        exr.read(path, max_pixels=5)


def with_window(data, *corners):
    mark = b"dataWindow\0box2i\0"
    start = data.index(mark) + len(mark) + 4
    return data[:start] + struct.pack("<4i", *corners) + data[start + 16 :]


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        # Whole chunks are missing: OpenEXR would return the first rows without an error.
        ((0, 0, 49, 31), "its height 32 does not fit its chunks"),
        ((0, 0, 49, 47), "damaged"),
        ((0, 0, 48, 39), "damaged"),
        ((0, 0, 2**15, 2**15), r"must have at most `max_pixels=268435456`"),
        ((5, 0, 3, 39), r"its data window is -1 x 40|damaged"),
    ],
)
def test_a_damaged_data_window(tmp_path, capfd, corners, message):
    path = tmp_path / "a.exr"
    exr.write(path, np.random.default_rng(0).random((40, 50, 3), np.float32))
    path.write_bytes(with_window(path.read_bytes(), *corners))
    with pytest.raises(ValueError, match=rf"a.exr` .*{message}"):
        exr.read(path, verify=False)
    assert capfd.readouterr().out == ""


def test_mutated_files_raise_or_come_back_whole(tmp_path, capfd):
    """Without a checksum, by the structure of the file alone."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :30].astype(np.float32)
    channels = {
        "": rng.random((40, 30, 3), np.float32),
        "depth": x + y,
        "normal": np.stack([x, y, x * y], axis=-1).astype(np.float16),
    }
    path = tmp_path / "a.exr"
    exr.write(path, channels)
    data = path.read_bytes()
    header = data.index(b"screenWindowWidth") + 40

    def cut(i):
        return data[: rng.integers(len(data))]

    def flip(i):
        at = rng.integers(header if i % 2 else len(data))
        return data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]

    def scramble(i):
        at = rng.integers(header if i % 2 else len(data) - 16)
        return data[:at] + rng.bytes(16) + data[at + 16 :]

    raised = {}
    for mutate in (cut, flip, scramble):
        for i in range(60):
            path.write_bytes(mutate(i))
            with pytest.raises(ValueError, match=r"a\.exr` "):
                exr.read(path)
            try:
                layers = exr.read(path, verify=False)
            except ValueError as error:
                assert str(path) in str(error)
                raised[mutate] = raised.get(mutate, 0) + 1
            else:
                # If a letter of a name has changed, there are more layers, of the same pixels.
                assert all(layer.shape[:2] == (40, 30) for layer in layers.values())
                assert sum(layer[0, 0].size for layer in layers.values()) == 7
    assert raised[cut] == 60
    assert raised[flip] > 20
    assert raised[scramble] > 40
    assert capfd.readouterr().out == ""


def test_a_file_rewritten_with_our_header(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, {"x": plane(1)})
    file = OpenEXR.File(str(path), separate_channels=True)
    file.channels()["x.V"].pixels = plane(2)
    file.write(str(path))
    with pytest.raises(ValueError, match=r"a.exr` is damaged.*`verify=False` reads it"):
        exr.read(path)
    assert_same(exr.read(path, verify=False), {"x": plane(2)})
