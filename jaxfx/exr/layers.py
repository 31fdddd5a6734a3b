"""EXR files as arrays by name. How keys become channels is in the package's docstring."""

import contextlib
import io
import os
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxfx._files import StrPath, write_whole


MAX_PIXELS = 2**28

_VECTORS = {"normal", "position", "direction", "tangent", "velocity", "motion", "vector"}
# Nuke writes words for letters.
_LETTERS = {"RED": "R", "GREEN": "G", "BLUE": "B", "ALPHA": "A"}
# Rows in one chunk of a ZIP-compressed file.
_CHUNK = 16
# Two attributes of our own, so that no damage to a single byte makes a file look foreign; and
# the first one as it stands in a file, before the four bytes of its value.
_CHECKSUM, _VERSION = "jaxfx.crc32", "jaxfx.version"
_SEAL = _CHECKSUM.encode() + b"\0int\0" + (4).to_bytes(4, "little")


def _storable(name: str, array: np.ndarray) -> np.ndarray:
    """`array` in one of EXR's three types."""
    kind = array.dtype.kind
    if array.dtype in (np.float16, np.float32):
        return array
    if kind not in "fbui":
        raise ValueError(f"`{name}` must hold real numbers, got {array.dtype}.")
    stored_type = np.uint32 if kind in "bu" else np.float32
    with np.errstate(over="ignore"):
        stored = array.astype(stored_type)
    if kind == "f" and not np.array_equal(np.isinf(stored), np.isinf(array)):
        raise ValueError(f"`{name}` must fit float32 (EXR has no double), got larger numbers.")
    limit = 2**32 - 1 if kind in "bu" else 2**24
    if kind != "f" and (array.max() > limit or array.min() < -limit):
        raise ValueError(
            f"`{name}` must be of integers that {stored_type.__name__} holds, "
            f"got {array.min()} to {array.max()}."
        )
    return stored


def _letters(key: str, shape: tuple[int, ...]) -> str:
    """The last letters of a layer's channels; none where EXR has none for it."""
    word = key.rpartition(".")[2].lower()
    if len(shape) == 2:
        return "" if key == "" else "Z" if word == "depth" else "V"
    families = {1: "Y", 2: "" if key == "" else "XY", 3: "RGB", 4: "RGBA"}
    if word in _VECTORS:
        families |= {3: "XYZ", 4: "XYZW"}
    return families.get(shape[2], "")


def _planes(channels: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The channels of the file: an array for each letter."""
    planes: dict[str, np.ndarray] = {}
    size = None
    for key, value in channels.items():
        name = f"write(channels[{key!r}])"
        if not isinstance(key, str) or "\0" in key or len(key.encode()) > 253:
            raise ValueError(f"`{name}` must be named by at most 253 bytes, none of them 0.")
        array = np.asarray(value)
        letters = _letters(key, array.shape) if array.ndim in (2, 3) and array.size else ""
        if not letters:
            expected = (
                "(height, width, 1, 3 or 4); give other data a name"
                if key == ""
                else "(height, width) or (height, width, 1 to 4), none of them 0"
            )
            raise ValueError(f"`{name}` must have shape {expected}, got {array.shape}.")
        size = size or array.shape[:2]
        if array.shape[:2] != size:
            raise ValueError(
                f"`{name}` must have the others' height and width {size}, "
                f"got {array.shape[:2]}."
            )
        array = _storable(name, array)
        columns = [array] if array.ndim == 2 else [*np.moveaxis(array, 2, 0)]
        for letter, column in zip(letters, columns, strict=True):
            # OpenEXR writes wrong pixels, without a word, where strides are not the plain ones.
            planes[f"{key}.{letter}" if key else letter] = np.ascontiguousarray(column)
    if not planes:
        raise ValueError("`write(channels)` must have a channel, got none.")
    return planes


def write_planes(
    path: StrPath, channels: Mapping[str, Any], attributes: Mapping[str, Any]
) -> None:
    """Write `channels`, and `attributes` into the header."""
    import OpenEXR

    planes = _planes(channels)
    height = next(iter(planes.values())).shape[0]
    header = {
        **attributes,
        _CHECKSUM: 0,
        _VERSION: 1,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        # So that `_size` notices a damaged height even unverified; OpenEXR would not.
        "chunkCount": -(-height // _CHUNK),
    }
    stream = io.BytesIO()
    OpenEXR.File(header, planes).write(stream)
    data = bytearray(stream.getvalue())
    at = _value_of_seal(data)
    data[at : at + 4] = _checksum(data, at).to_bytes(4, "little")
    write_whole(path, data)


def _value_of_seal(data: bytes | bytearray) -> int:
    """Where the checksum stands in a file; -1 where it has none."""
    start = data.find(_SEAL)
    return start if start < 0 else start + len(_SEAL)


def _checksum(data: bytes | bytearray, at: int) -> int:
    """CRC-32 of a file, the four bytes of the checksum itself as zeros."""
    view = memoryview(data)
    return zlib.crc32(view[at + 4 :], zlib.crc32(bytes(4), zlib.crc32(view[:at])))


def _verify(path: StrPath, data: bytes) -> None:
    """Raise `ValueError` if `data` is a file of our own that has changed since."""
    if _CHECKSUM.encode() not in data and _VERSION.encode() not in data:
        return
    at = _value_of_seal(data)
    if at < 0 or data[at : at + 4] != _checksum(data, at).to_bytes(4, "little"):
        raise ValueError(
            f"`{path}` is damaged: its checksum does not fit. If another program has rewritten "
            "it, `verify=False` reads it."
        )


def write(path: StrPath, channels: Mapping[str, Any] | ArrayLike) -> None:
    """Write an EXR file, ZIP-compressed, whole or not at all.

    **Arguments:**

    - `path`: the file; an old one is replaced once the new one is complete.
    - `channels`: arrays by name, each height width or height width channel (1 to 4), all of
      one height and width; the key `""` is the main picture. An image alone is taken for it.
      The module's tables say how names and numbers are stored.

    **Raises:** `ValueError` for an array that EXR can't hold; `OSError` where the folder does
    not exist or can't be written.

    **Gradient:** none; the host side.
    """
    write_planes(path, channels if isinstance(channels, Mapping) else {"": channels}, {})


def _open(path: StrPath, *, header_only: bool) -> list[Any]:
    """The parts of a file."""
    import OpenEXR

    said = io.StringIO()
    try:
        # OpenEXR leaves a part out that it can't read, and says so on stdout only.
        with contextlib.redirect_stdout(said):
            file = OpenEXR.File(
                os.fspath(path), separate_channels=True, header_only=header_only
            )
    except Exception as error:
        raise ValueError(f"`{path}` is damaged: {error}") from error
    if said.getvalue() or not file.parts:
        raise ValueError(f"`{path}` is damaged: {said.getvalue().strip() or 'it has no part'}")
    return file.parts


def _size(path: StrPath, header: Mapping[str, Any], max_pixels: int) -> tuple[int, int]:
    """Height and width of a part that can be read; `ValueError` otherwise."""
    import OpenEXR

    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    height, width = bottom - top + 1, right - left + 1
    if height < 1 or width < 1:
        raise ValueError(f"`{path}` is damaged: its data window is {width} x {height}.")
    if height * width > max_pixels:
        raise ValueError(
            f"`{path}` must have at most `max_pixels={max_pixels}`, got {width} x {height}."
        )
    scanlines = header["type"] == OpenEXR.scanlineimage
    if not scanlines and header["type"] != OpenEXR.tiledimage:
        raise ValueError(f"`{path}` must hold flat pixels, got deep ones.")
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in header["channels"]):
        raise ValueError(f"`{path}` must have every channel in every pixel, got subsampling.")
    chunks = -(-height // _CHUNK)
    zipped = scanlines and header["compression"] == OpenEXR.ZIP_COMPRESSION
    if zipped and header.get("chunkCount", chunks) != chunks:
        raise ValueError(f"`{path}` is damaged: its height {height} does not fit its chunks.")
    return height, width


def read_planes(
    path: StrPath, max_pixels: int, verify: bool
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Every channel of a file by its full name, and the header of its first part."""
    with open(path, "rb") as file:
        magic = file.read(4)
        if magic != b"v/1\x01":
            found = f"got one that begins with {magic!r}" if magic else "got an empty one"
            raise ValueError(f"`{path}` must be an OpenEXR file, {found}.")
        if verify:
            _verify(path, magic + file.read())
    headers = [part.header for part in _open(path, header_only=True)]
    sizes = [_size(path, header, max_pixels) for header in headers]
    parts = _open(path, header_only=False)
    if len(parts) != len(headers):
        raise ValueError(f"`{path}` is damaged: {len(parts)} of {len(headers)} parts are left.")

    planes: dict[str, np.ndarray] = {}
    for i, (part, header, size) in enumerate(zip(parts, headers, sizes, strict=True)):
        if part.channels.keys() != {channel.name for channel in header["channels"]}:
            raise ValueError(f"`{path}` is damaged: part {i} lacks channels.")
        for name, channel in part.channels.items():
            # A later part may bear the layer's name in place of its channels.
            full = f"{part.name()}.{name}" if i and part.name() and "." not in name else name
            if full in planes or np.shape(channel.pixels) != size:
                raise ValueError(f"`{path}` is damaged: part {i} has a wrong channel `{full}`.")
            planes[full] = channel.pixels
    return planes, headers[0]


def assemble(path: StrPath, planes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Channels put together to layers: what `_planes` took apart, and what others write."""
    groups: dict[str, dict[str, str]] = {}
    for name in planes:
        layer, _, suffix = name.rpartition(".")
        letter = _LETTERS.get(suffix.upper(), suffix.upper())
        group = groups.setdefault(layer, {})
        group[f".{name}" if letter in group else letter] = name

    layers: dict[str, np.ndarray] = {}
    for layer, group in groups.items():
        within = ("RGBA", "RGB", "XYZW", "XYZ") if layer else ("RGBA", "RGB")
        alone = ("XY", "Y", "Z", "V") if layer else ("Y",)
        families = [family for family in within if group.keys() >= set(family)]
        families += [family for family in alone if group.keys() == set(family)]
        found = {}
        if families:
            members = [planes[group.pop(letter)] for letter in families[0]]
            scalar = families[0] in ("Z", "V")
            found[layer] = members[0] if scalar else np.stack(members, axis=-1)
        found |= {name: planes[name] for name in group.values()}
        if twice := found.keys() & layers.keys():
            raise ValueError(f"`{path}` must name its layers differently, got {twice} twice.")
        layers |= found
    return layers


def read(
    path: StrPath, *, max_pixels: int = MAX_PIXELS, verify: bool = True
) -> dict[str, np.ndarray]:
    """Read an EXR file: what `write` wrote, to the bit, under the same keys.

    Files of other programs are read too, of one part or several, in scan lines or tiles; an
    array is the data window. A channel of no colour or vector, a bare `Z` say, is a layer
    under its full name.

    **Arguments:**

    - `path`: the file.
    - `max_pixels`: the largest width times height to accept, 2**28 by default, so that a
      damaged header can't ask for all memory.
    - `verify`: whether a file of `write`'s must fit its checksum. One that another program has
      rewritten, header and all, does not fit it any more; False reads it all the same.

    **Returns:** arrays by name, height width or height width channel.

    **Raises:** `ValueError` that names the file where it is damaged, not EXR, deep, subsampled
    or too large: all channels come back, or none. `OSError` where it can't be opened. EXR has
    no checksum, so `write` puts one into the header: any bit that flips in its files is
    noticed. In a file of another program, damage that makes another valid file is not.

    **Gradient:** none; the host side.
    """
    return assemble(path, read_planes(path, max_pixels, verify)[0])
