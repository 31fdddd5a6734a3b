"""The parts of an EXR file, read by OpenEXR: all of them, or an error."""

import builtins
import io
from collections.abc import Mapping
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from jaxfx._extras import needs
from jaxfx._files import StrPath
from jaxfx.exr import _seal


# Default limit of width times height: a damaged header can't ask for more than about 1 GiB per
# channel. A larger image needs `max_pixels`.
MAX_PIXELS = 2**28

# Rows in one chunk of a ZIP-compressed file, by the format.
CHUNK = 16

# An EXR file's first bytes. In the byte after the next, this bit says that parts are deep.
_MAGIC = b"v/1\x01"
_DEEP = 0x08


def _import_all_but_sys(name: str, *context: Any) -> Any:
    """`__import__` that fails for `sys`; see `_without_print`."""
    if name == "sys":
        raise ImportError("`sys` is not available here")
    return builtins.__import__(name, *context)


# `_without_print(function, *args)` calls a function of OpenEXR that can't print. Where OpenEXR
# can't read a part's pixels, it leaves the part out and says so on stdout only, by pybind11's
# `print`. That imports `sys` by the `__import__` of the caller's globals, and is silent where
# this fails. Redirecting stdout instead would also hide what other threads print.
_without_print = FunctionType(
    (lambda function, *args, **options: function(*args, **options)).__code__,
    {"__builtins__": {"__import__": _import_all_but_sys}},
)


class Part(NamedTuple):
    """One part of a file: its attributes, and its channels' pixels by name."""

    header: Mapping[str, Any]
    planes: dict[str, np.ndarray]


def read_parts(path: StrPath, max_pixels: int, verify: bool) -> list[Part]:
    """Every part with every channel; `ValueError` names the file where one can't be read."""
    data = Path(path).read_bytes()
    if data[:4] != _MAGIC:
        got = f"one that begins with {data[:4]!r}" if data else "an empty one"
        raise ValueError(f"`{path}` must be an OpenEXR file, got {got}.")
    if verify:
        _seal.verify(path, data)
    if data[5:6] and data[5] & _DEEP:
        raise ValueError(f"`{path}` must hold flat pixels, got deep ones.")

    headers = [part.header for part in _open(path, data, header_only=True)]
    if not headers:
        raise ValueError(f"`{path}` is damaged: it has no part.")
    sizes = [_size(path, header, max_pixels) for header in headers]
    by_index = {part.part_index: part for part in _open(path, data, header_only=False)}
    if lost := [i for i in range(len(headers)) if i not in by_index]:
        raise ValueError(f"`{path}` is damaged: the pixels of part {lost[0]} cannot be read.")
    parts = []
    for i, (header, size) in enumerate(zip(headers, sizes, strict=True)):
        planes = {name: channel.pixels for name, channel in by_index[i].channels.items()}
        is_complete = planes.keys() == {channel.name for channel in header["channels"]}
        if not is_complete or any(plane.shape != size for plane in planes.values()):
            raise ValueError(f"`{path}` is damaged: part {i} lacks channels.")
        parts.append(Part(header, planes))
    return parts


def _open(path: StrPath, data: bytes, *, header_only: bool) -> list[Any]:
    """OpenEXR's parts of a file, those with damaged pixels left out."""
    with needs("io"):
        import OpenEXR

    options = {"separate_channels": True, "header_only": header_only}
    try:
        return _without_print(OpenEXR.File, io.BytesIO(data), **options).parts
    except Exception as error:
        raise ValueError(f"`{path}` is damaged, or not what OpenEXR reads: {error}") from error


def _size(path: StrPath, header: Mapping[str, Any], max_pixels: int) -> tuple[int, int]:
    """A part's height and width; `ValueError` where it is too large or of a kind not read."""
    with needs("io"):
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
    chunks = -(-height // CHUNK)
    zipped = scanlines and header["compression"] == OpenEXR.ZIP_COMPRESSION
    if zipped and header.get("chunkCount", chunks) != chunks:
        raise ValueError(f"`{path}` is damaged: its height {height} does not fit its chunks.")
    return height, width


def full_names(path: StrPath, parts: list[Part]) -> dict[str, tuple[Part, str]]:
    """All channels under names that are unique in the file: each one's part, and name there.

    A name with a dot is kept if only one part has it. If the parts that share it have different
    views, the view is put before the last word, as in a file of one part: `depth.right.Z`. To
    any other name of a second or later part, the part's name is prefixed.
    """
    views: dict[str, list[str | None]] = {}
    for part in parts:
        for name in part.planes:
            views.setdefault(name, []).append(part.header.get("view"))
    channels: dict[str, tuple[Part, str]] = {}
    for i, part in enumerate(parts):
        label = part.header.get("name", "")
        for name in part.planes:
            layer, dot, letter = name.rpartition(".")
            is_shared = len(views[name]) > 1
            if dot and is_shared and None not in views[name] and _differ(views[name]):
                full = f"{layer}.{part.header['view']}.{letter}"
            elif i and label and (not dot or is_shared):
                full = f"{label}.{name}"
            else:
                full = name
            if full in channels:
                raise ValueError(
                    f"`{path}` must name its channels differently, got `{full}` twice."
                )
            channels[full] = part, name
    return channels


def _differ(names: list[Any]) -> bool:
    """Whether no two of the names are equal."""
    return len(set(names)) == len(names)


def planes_of(channels: Mapping[str, tuple[Part, str]]) -> dict[str, np.ndarray]:
    """The pixels of each of the channels that `full_names` lists."""
    return {full: part.planes[name] for full, (part, name) in channels.items()}
