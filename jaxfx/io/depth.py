"""Depth or disparity from image files, as the numbers that they store."""

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


# The first bytes of NPY files, and of NPZ files, which are ZIP archives.
_NPY, _ZIP = b"\x93NUMPY", b"PK\x03\x04"
# "Pf", width, height and scale, each ended by one or more blanks, the last by exactly one.
_PFM = re.compile(rb"(P[fF]4?)\s+(\d+)\s+(\d+)\s+([-+0-9.eE]+)\s")
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
# Pillow's layouts of grey that it decodes as stored; it scales greys of fewer bits to 8.
_GREYS = ("L", "I;16B")


def read_depth(path: StrPath, *, layer: str | None = None) -> Num[np.ndarray, "height width"]:
    """Read a depth, ray distance or disparity as the numbers that the file stores.

    `jaxfx.depth` converts them: here no curve or unit is applied, and holes stay as they are.

    **Arguments:**

    - `path`: a PNG file of grey (8 or 16 bits), an EXR, PFM or NPY file, or an NPZ file with
      one array or one called `depth`. The format is recognised by the first bytes.
    - `layer`: the layer of an EXR file whose pass `Depth` (or `Z`) is read, as for
      `exr.read_rgbd`. A file without such a pass must hold one grey image: one channel, or
      three that are equal.

    **Returns:** height width, row 0 at the top, in the file's type: integers from PNG, floats
    from EXR and PFM, either from NPY. The scale in a PFM file's header is not applied.

    **Raises:** `ValueError` that names the file where it is damaged, of another format, has
    colours, a palette or alpha, or has several layers; `OSError` where it can't be opened.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import depth, io
    >>> np.save("millimetres.npy", np.full((6, 8), 2500, np.uint16))
    >>> millimetres = io.read_depth("millimetres.npy")
    >>> print(depth.clean(millimetres, unit=1e-3)[0, 0])
    2.5
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
        hint = ": JPEG does not store exact numbers" if data.startswith(JPEG) else ""
        got = f"one that begins with {data[:4]!r}" if data else "an empty one"
        raise ValueError(f"`{path}` must be a PNG, EXR, PFM, NPY or NPZ file, got {got}{hint}.")
    return _one_channel(path, array)


def _one_channel(path: StrPath, array: np.ndarray) -> np.ndarray:
    """`array` as height width: one channel, or three that are equal; else `ValueError`."""
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
    """The pass `Depth` of a layer, or the file's only image where it has no such pass."""
    layers = exr.read(path)
    depths = depths_of(layers)
    if depths or layer is not None:
        return flat(layers[depths[choose(path, "a depth", depths, layer)]])
    if [*layers] not in ([""], ["R"], ["V"]):
        raise ValueError(
            f"`{path}` must have a pass `Depth` or `Z` of one channel, got {sorted(layers)}."
        )
    (array,) = layers.values()
    return _one_channel(path, array[..., :3] if array.ndim == 3 else array)


def _from_png(path: StrPath, data: bytes) -> np.ndarray:
    """The codes of a grey PNG file, uint8 or uint16; of three equal channels, all three."""
    with needs("io"):
        from PIL import Image

    try:
        image = Image.open(BytesIO(data), formats=("PNG",))
        layout, mode = image.tile[0][3], image.mode
        array = np.asarray(image)
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not PNG: {error}") from error
    if layout == "RGB" and (array == array[..., :1]).all():
        return array
    if layout not in _GREYS or "transparency" in image.info:
        raise ValueError(
            f"`{path}` must be of grey, 8 or 16 bits, without alpha, to be a depth, got a PNG "
            f"of {'a palette' if mode == 'P' else layout}."
        )
    return array.astype(np.uint16 if layout == "I;16B" else np.uint8)


def _from_numpy(path: StrPath, data: bytes) -> np.ndarray:
    """The array of an NPY file; of NPZ the only one, or `depth`."""
    try:
        loaded = np.load(BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        # An archive may hold files that are no arrays: of those, NumPy returns the bytes.
        members = {name: loaded[name] for name in loaded.files}
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not of NumPy: {error}") from error
    arrays = {name: array for name, array in members.items() if isinstance(array, np.ndarray)}
    names = arrays if len(arrays) == 1 else arrays.keys() & {"depth"}
    if not names:
        raise ValueError(
            f"`{path}` must have one array, or one called `depth`, got {sorted(arrays)}."
        )
    return arrays[next(iter(names))]


def _from_pfm(path: StrPath, data: bytes) -> np.ndarray:
    """The pixels of a PFM file, float32, row 0 at the top: the file begins with the bottom row.

    The scale in the header is negative where the low byte comes first. Its magnitude is not
    applied: in Middlebury's disparities it is 1 / 255, for viewers; programs differ in whether
    they multiply or divide by it.
    """
    header = _PFM.match(data)
    if not header:
        raise ValueError(f"`{path}` is damaged or not PFM: it begins with {data[:40]!r}.")
    kind, width, height, number = header.groups()
    shape = int(height), int(width), 3 if kind == b"PF" else 1
    body = data[header.end() :]
    # The byte order is unknown unless the scale is a number other than 0.
    factor = float(number) if _NUMBER.fullmatch(number) else 0.0
    is_complete = len(body) == 4 * shape[0] * shape[1] * shape[2]
    if kind.endswith(b"4") or not is_complete or not 0 < abs(factor) < float("inf"):
        raise ValueError(
            f"`{path}` is damaged: its header {header.group()!r} does not fit its {len(body)} "
            "bytes of pixels."
        )
    values = np.frombuffer(body, "<f4" if factor < 0 else ">f4").reshape(shape)
    return values[::-1].astype(np.float32)
