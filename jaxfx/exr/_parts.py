"""The parts of an EXR file, as OpenEXR reads them: all of them, or none."""

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


MAX_PIXELS = 2**28

# Rows in one chunk of a ZIP-compressed file.
CHUNK = 16

_MAGIC = b"v/1\x01"
# In the second byte of the version, which follows: the file has deep parts.
_DEEP = 0x08


def _import_but_sys(name: str, *context: Any) -> Any:
    if name == "sys":
        raise ImportError("`sys` is not to be had here")
    return builtins.__import__(name, *context)


# Where OpenEXR cannot read the pixels of a part it leaves the part out, and says so on stdout
# only, by pybind11's `print`. That looks for `sys.stdout` through the `__import__` of the
# caller's globals, and stays silent where it gets none. So nothing is printed, and no state of
# the process changes: to redirect stdout would take from other threads what they print.
_quietly = FunctionType(
    (lambda function, *args, **options: function(*args, **options)).__code__,
    {"__builtins__": {"__import__": _import_but_sys}},
)


class Part(NamedTuple):
    """One image of a file: its attributes, and its pixels by the channels' own names."""

    header: Mapping[str, Any]
    planes: dict[str, np.ndarray]


def read_parts(path: StrPath, max_pixels: int, verify: bool) -> list[Part]:
    """Every part with every channel; `ValueError` names the file otherwise."""
    data = Path(path).read_bytes()
    if data[:4] != _MAGIC:
        found = f"got one that begins with {data[:4]!r}" if data else "got an empty one"
        raise ValueError(f"`{path}` must be an OpenEXR file, {found}.")
    if verify:
        _seal.verify(path, data)
    if data[5:6] and data[5] & _DEEP:
        raise ValueError(f"`{path}` must hold flat pixels, got deep ones.")

    headers = [part.header for part in _open(path, data, header_only=True)]
    if not headers:
        raise ValueError(f"`{path}` is damaged: it has no part.")
    sizes = [_size(path, header, max_pixels) for header in headers]
    found = {part.part_index: part for part in _open(path, data, header_only=False)}
    if lost := [i for i in range(len(headers)) if i not in found]:
        raise ValueError(f"`{path}` is damaged: the pixels of part {lost[0]} cannot be read.")
    parts = []
    for i, (header, size) in enumerate(zip(headers, sizes, strict=True)):
        planes = {name: channel.pixels for name, channel in found[i].channels.items()}
        whole = planes.keys() == {channel.name for channel in header["channels"]}
        if not whole or any(plane.shape != size for plane in planes.values()):
            raise ValueError(f"`{path}` is damaged: part {i} lacks channels.")
        parts.append(Part(header, planes))
    return parts


def _open(path: StrPath, data: bytes, *, header_only: bool) -> list[Any]:
    with needs("io"):
        import OpenEXR

    options = {"separate_channels": True, "header_only": header_only}
    try:
        return _quietly(OpenEXR.File, io.BytesIO(data), **options).parts
    except Exception as error:
        raise ValueError(f"`{path}` is damaged, or not what OpenEXR reads: {error}") from error


def _size(path: StrPath, header: Mapping[str, Any], max_pixels: int) -> tuple[int, int]:
    """Height and width of a part that can be read; `ValueError` otherwise."""
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
    """The channels of all parts, each under a name of its own: its part, and its name there.

    A name with a dot stays as it is where one part alone has it. Where the parts that share
    it are of different views, the view stands before its last word, as in a file of one part:
    `depth.right.Z`. Every other name of a later part follows the part's.
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
    return len(set(names)) == len(names)


def planes_of(channels: Mapping[str, tuple[Part, str]]) -> dict[str, np.ndarray]:
    """The pixels of each of `full_names`."""
    return {full: part.planes[name] for full, (part, name) in channels.items()}
