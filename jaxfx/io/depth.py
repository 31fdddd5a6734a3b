"""Images of depth or disparity from any file, as the numbers that it stores."""

import re
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Num

from jaxfx import exr
from jaxfx._extras import needs
from jaxfx._files import StrPath
from jaxfx.exr.rgbd import choose, depths_of, flat
from jaxfx.io.color import EXR, JPEG, PNG


_NPY, _ZIP = b"\x93NUMPY", b"PK\x03\x04"
# "Pf", width, height and scale, each ended by one or more blanks, the last by exactly one.
_PFM = re.compile(rb"(P[fF]4?)\s+(\d+)\s+(\d+)\s+([-+0-9.eE]+)\s")
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
# Greys that Pillow gives as the file has them; it spreads those of fewer bits.
_GREYS = ("L", "I;16B")


def read_depth(path: StrPath, *, layer: str | None = None) -> Num[np.ndarray, "height width"]:
    """Read the numbers of a depth, a ray distance or a disparity as the file stores them.

    What they mean is for `jaxfx.depth` to say: no curve is applied, no unit, and holes are as
    they were.

    >>> depth.clean(io.read_depth("kinect.png"), scale=1 / 5000)  # doctest: +SKIP

    **Arguments:**

    - `path`: a PNG file of grey (8 or 16 bits), an EXR file, PFM, NPY, or an NPZ file with
      one array or one named `depth`. What it is, its first bytes say, not its name.
    - `layer`: of an EXR file with several layers the one whose pass `Depth` (or `Z`) is
      wanted, as for `exr.read_rgbd`. A file with no such pass must hold one grey image: a
      channel alone, or colours that are all alike.

    **Returns:** height width, in the type of the file: integers from PNG, floats from EXR and
    PFM, either from NPY. PFM begins with the bottom row, which is put in its place; the number
    in its header tells the order of bytes, and is not applied.

    **Raises:** `ValueError` that names the file where it is damaged, of another format, of
    colours, a palette or alpha, or has several layers; `OSError` where it can't be opened.

    **Gradient:** none; the host side.
    """
    data = Path(path).read_bytes()
    if data.startswith(EXR):
        return _from_exr(path, layer)
    if layer is not None:
        raise ValueError(f"`{path}` must be an EXR file to have a layer `{layer}`.")
    if data.startswith(PNG):
        array = _from_png(path, data)
    elif data.startswith((_NPY, _ZIP)):
        array = _from_numpy(path, data)
    elif data.startswith((b"Pf", b"PF")):
        array = _from_pfm(path, data)
    else:
        hint = ": what JPEG stores is not exact" if data.startswith(JPEG) else ""
        found = f"one that begins with {data[:4]!r}" if data else "an empty one"
        raise ValueError(
            f"`{path}` must be a PNG, EXR, PFM, NPY or NPZ file, got {found}{hint}."
        )
    return _one_channel(path, array)


def _one_channel(path: StrPath, array: np.ndarray) -> np.ndarray:
    """`array` as height width; colours that are all alike are one."""
    if array.ndim == 3 and array.shape[2] in (1, 3) and (array == array[..., :1]).all():
        array = array[..., 0]
    is_real = array.dtype.kind in "fiu"
    if array.ndim != 2 or not array.size or not is_real:
        raise ValueError(
            f"`{path}` must have one channel of real numbers, height width, got {array.dtype} "
            f"of shape {array.shape}."
        )
    return np.ascontiguousarray(array, array.dtype.newbyteorder("="))


def _from_exr(path: StrPath, layer: str | None) -> np.ndarray:
    layers = exr.read(path)
    depths = depths_of(layers)
    if depths or layer is not None:
        return flat(layers[depths[choose(path, "a depth", depths, layer)]])
    # No pass of that name: a single image, of grey.
    if [*layers] not in ([""], ["R"], ["V"]):
        raise ValueError(f"`{path}` must have a pass `Depth` or `Z`, got {sorted(layers)}.")
    (array,) = layers.values()
    return _one_channel(path, array[..., :3] if array.ndim == 3 else array)


def _from_png(path: StrPath, data: bytes) -> np.ndarray:
    with needs("io"):
        from PIL import Image

    try:
        picture = Image.open(BytesIO(data), formats=("PNG",))
        layout, mode = picture.tile[0][3], picture.mode
        array = np.asarray(picture)
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not PNG: {error}") from error
    if layout == "RGB" and (array == array[..., :1]).all():
        return array
    if layout not in _GREYS or "transparency" in picture.info:
        raise ValueError(
            f"`{path}` must be of grey, 8 or 16 bits, without alpha, to be a depth, got a PNG "
            f"of {'a palette' if mode == 'P' else layout}."
        )
    return array.astype(np.uint16 if layout == "I;16B" else np.uint8)


def _from_numpy(path: StrPath, data: bytes) -> np.ndarray:
    try:
        loaded = np.load(BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        arrays = {name: loaded[name] for name in loaded.files}
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not of NumPy: {error}") from error
    chosen = arrays if len(arrays) == 1 else arrays.keys() & {"depth"}
    if not chosen:
        raise ValueError(
            f"`{path}` must have one array, or one named `depth`, got {sorted(arrays)}."
        )
    return arrays[next(iter(chosen))]


def _from_pfm(path: StrPath, data: bytes) -> np.ndarray:
    """Rows from the bottom; a scale below 0 says that the low byte comes first.

    Its size is not applied. Middlebury's disparities have 1 / 255 there, for viewers; other
    programs multiply by it, or divide.
    """
    header = _PFM.match(data)
    if not header:
        raise ValueError(f"`{path}` is damaged or not PFM: it begins with {data[:40]!r}.")
    kind, width, height, number = header.groups()
    shape = int(height), int(width), 3 if kind == b"PF" else 1
    body = data[header.end() :]
    # Anything but a number above or below 0 leaves the order of bytes open.
    factor = float(number) if _NUMBER.fullmatch(number) else 0.0
    is_whole = len(body) == 4 * shape[0] * shape[1] * shape[2]
    if kind.endswith(b"4") or not is_whole or not 0 < abs(factor) < float("inf"):
        raise ValueError(
            f"`{path}` is damaged: its header {header.group()!r} does not fit its {len(body)} "
            "bytes of pixels."
        )
    values = np.frombuffer(body, "<f4" if factor < 0 else ">f4").reshape(shape)
    return values[::-1].astype(np.float32)
