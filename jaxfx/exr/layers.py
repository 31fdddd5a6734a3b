"""EXR files as arrays by name. The package's docstring says how keys become channels."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_numpy
from jaxfx._extras import needs
from jaxfx._files import StrPath, check_suffix, write_whole
from jaxfx.exr import _seal
from jaxfx.exr._parts import CHUNK, MAX_PIXELS, full_names, planes_of, read_parts


# Last words of keys whose arrays are vectors, with channels X, Y, Z instead of R, G, B.
_VECTORS = {"normal", "position", "direction", "tangent", "velocity", "motion", "vector"}
# Nuke writes these words instead of letters.
_LETTERS = {"RED": "R", "GREEN": "G", "BLUE": "B", "ALPHA": "A"}


def _storable(name: str, array: np.ndarray) -> np.ndarray:
    """`array` in a type that EXR has: float16, float32 or uint32; `ValueError` names it."""
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
    """The letters of a layer's channels; "" where the shape is not one that is written."""
    word = key.rpartition(".")[2].lower()
    if len(shape) == 2:
        return "" if key == "" else "Z" if word == "depth" else "V"
    families = {1: "Y", 2: "" if key == "" else "XY", 3: "RGB", 4: "RGBA"}
    if word in _VECTORS:
        families |= {3: "XYZ", 4: "XYZW"}
    return families.get(shape[2], "")


def _planes(channels: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The file's channels by name, height width each; `ValueError` for what can't be stored."""
    planes: dict[str, np.ndarray] = {}
    size = None
    for key, value in channels.items():
        name = f"write(channels[{key!r}])"
        if not isinstance(key, str) or "\0" in key or len(key.encode()) > 253:
            raise ValueError(f"`{name}` must be named by at most 253 bytes, none of them 0.")
        array = as_numpy(name, value)
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
            # OpenEXR writes wrong pixels of arrays that are not contiguous, without an error.
            planes[f"{key}.{letter}" if key else letter] = np.ascontiguousarray(column)
    if not planes:
        raise ValueError("`write(channels)` must have a channel, got none.")
    return planes


def write_planes(
    path: StrPath, channels: Mapping[str, Any], attributes: Mapping[str, Any]
) -> None:
    """Write arrays by name, with extra attributes in the header."""
    with needs("io"):
        import OpenEXR

    planes = _planes(channels)
    height = next(iter(planes.values())).shape[0]
    header = {
        **attributes,
        _seal.CHECKSUM: 0,
        _seal.VERSION: 1,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        # With it, `read` notices a damaged height without the checksum, too.
        "chunkCount": -(-height // CHUNK),
    }
    stream = io.BytesIO()
    OpenEXR.File(header, planes).write(stream)
    data = bytearray(stream.getvalue())
    _seal.seal(data)
    write_whole(path, data)


def write(path: StrPath, channels: Mapping[str, Any] | ArrayLike) -> None:
    """Write an image, or several arrays by name, as an EXR file.

    It is compressed without loss (ZIP), and written whole or not at all.

    **Arguments:**

    - `path`: the file; an old one is replaced once the new one is complete.
    - `channels`: an image, or arrays by name, each height width or height width channel (1 to
      4), all of one height and width. The key `""` is the main image. The package's tables say
      how names and numbers are stored.

    **Raises:** `ValueError` for an array that EXR can't hold, or a path with another suffix
    than `.exr`; `OSError` where the folder does not exist or can't be written.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import exr
    >>> exr.write("frame.exr", {"": np.zeros((6, 8, 3)), "depth": np.ones((6, 8))})
    >>> {name: array.shape for name, array in exr.read("frame.exr").items()}
    {'': (6, 8, 3), 'depth': (6, 8)}
    """
    check_suffix("write(path)", path, ".exr")
    write_planes(path, channels if isinstance(channels, Mapping) else {"": channels}, {})


def read_planes(
    path: StrPath, max_pixels: int, verify: bool
) -> tuple[dict[str, np.ndarray], Mapping[str, Any]]:
    """All channels of a file by their full names, and the header of its first part."""
    parts = read_parts(path, max_pixels, verify)
    return planes_of(full_names(path, parts)), parts[0].header


def assemble(path: StrPath, planes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Channels combined to layers, whether `_planes` or another program named them."""
    groups: dict[str, dict[str, str]] = {}
    for name in planes:
        layer, _, suffix = name.rpartition(".")
        letter = _LETTERS.get(suffix.upper(), suffix.upper())
        group = groups.setdefault(layer, {})
        group[f".{name}" if letter in group else letter] = name

    layers: dict[str, np.ndarray] = {}
    for layer, group in groups.items():
        # Families that a group may have besides other channels; and those only by themselves.
        colors_vectors = ("RGBA", "RGB", "XYZW", "XYZ") if layer else ("RGBA", "RGB")
        alone = ("XY", "Y", "Z", "V") if layer else ("Y",)
        families = [family for family in colors_vectors if group.keys() >= set(family)]
        families += [family for family in alone if group.keys() == set(family)]
        arrays = {}
        # Parts of different sizes may share a layer's name.
        is_one_size = len({planes[name].shape for name in group.values()}) == 1
        if families and is_one_size:
            members = [planes[group.pop(letter)] for letter in families[0]]
            is_scalar = families[0] in ("Z", "V")
            arrays[layer] = members[0] if is_scalar else np.stack(members, axis=-1)
        arrays |= {name: planes[name] for name in group.values()}
        if twice := arrays.keys() & layers.keys():
            raise ValueError(f"`{path}` must name its layers differently, got {twice} twice.")
        layers |= arrays
    return layers


def read(
    path: StrPath, *, max_pixels: int = MAX_PIXELS, verify: bool = True
) -> dict[str, np.ndarray]:
    """Read every layer of an EXR file as an array by name.

    A file of `write` comes back to the bit, under the same keys. Files of other programs are
    read too.

    **Arguments:**

    - `path`: the file.
    - `max_pixels`: the largest width times height to accept, 2**28 by default, so that a
      damaged header can't ask for all memory.
    - `verify`: True checks the checksum of a file that `write` wrote. A program that rewrote
      such a file and kept its header made the checksum wrong: False reads it.

    **Returns:** arrays by name, height width or height width channel.

    **Raises:** `ValueError` that names the file where it is damaged, not EXR, deep, subsampled,
    too large or has one name twice; then no channel is returned. `OSError` where it can't be
    opened.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import exr
    >>> exr.write("frame.exr", {"": np.zeros((6, 8, 3)), "normal": np.ones((6, 8, 3))})
    >>> exr.read("frame.exr")["normal"].shape
    (6, 8, 3)

    Files of one part or several are read, in scan lines or tiles; an array is the data window,
    at full resolution. A channel that belongs to no colour or vector, such as a bare `Z`, is a
    layer under its full name. To a channel of a second or later part the part's name is
    prefixed, if it has no dot. If several parts share a name with a dot, the part's view is
    inserted, or, where views do not differ, the part's name prefixed: the depths of two views
    in two parts are `depth.left` and `depth.right`.

    EXR has no checksum, so `write` stores one in the header: any bit that flips in its files is
    noticed. In a file of another program, damage that makes another valid file is not.
    """
    return assemble(path, read_planes(path, max_pixels, verify)[0])
