"""PNG files: the numbers that they store, and images in linear light.

`jaxfx.scene` reads textures by `png_values`.
"""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_numpy
from jaxfx._extras import needs
from jaxfx._files import StrPath, check_suffix, write_whole
from jaxfx.io.srgb import linear_from_srgb, log_profile, recolor, srgb_from_linear


# The gamma that a file states to mean sRGB, and how far, relative to it, another one may be and
# still mean it: files round to a few digits.
_SRGB_GAMMA = 1 / 2.2
_GAMMA_TOLERANCE = 0.05


def write_png(path: StrPath, image: Float[ArrayLike, "height width channel"]) -> None:
    """Write an 8-bit sRGB PNG file of an image in linear light.

    It is written whole or not at all.

    **Arguments:**

    - `path`: the file; an old one is replaced once the new one is complete.
    - `image`: height width channel, linear: grey, grey and alpha, RGB or RGBA. Values are
      clipped to [0, 1] and rounded to the nearest of 256; NaN becomes 0. Alpha is stored
      linear.

    **Raises:** `ValueError` for anything but an image of 1 to 4 channels, or a path with
    another suffix than `.png`; `OSError` where the folder does not exist or can't be written.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import io
    >>> io.write_png("grey.png", np.full((6, 8, 3), 0.18))
    >>> print(io.read_png("grey.png")[0, 0].round(2))
    [0.18 0.18 0.18]
    """
    with needs("io"):
        from PIL import Image

    check_suffix("write_png(path)", path, ".png")
    array = as_numpy("write_png(image)", image)
    if array.ndim != 3 or not array.size or array.shape[2] > 4 or array.dtype.kind != "f":
        raise ValueError(
            "`write_png(image)` must hold floats of shape (height, width, 1 to 4), "
            f"got {array.dtype} of shape {array.shape}."
        )
    values = np.nan_to_num(array.astype(np.float64)).clip(0, 1)
    pixels = np.rint(255 * recolor(srgb_from_linear, values)).astype(np.uint8)
    stream = BytesIO()
    Image.fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels).save(stream, "PNG")
    write_whole(path, stream.getbuffer())


def read_png(path: StrPath) -> Float[np.ndarray, "height width channel"]:
    """Read a PNG image into linear light, at its full 8 or 16 bits.

    `read_depth` reads a PNG of depth: its numbers are not colours.

    **Arguments:** `path`: a PNG file. Its numbers are taken for sRGB, unless the file states
    another gamma; alpha is linear. A colour profile is not applied, which is logged where it is
    not sRGB.

    **Returns:** float32, height width channel, in [0, 1]: grey, grey and alpha, RGB or RGBA, as
    in the file. A palette is looked up; a colour declared transparent has alpha 0.

    **Raises:** `ValueError` that names the file where it is damaged or not PNG; `OSError` where
    it can't be opened.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import io
    >>> io.write_png("ramp.png", np.linspace(0, 1, 48).reshape(6, 8, 1))
    >>> io.read_png("ramp.png").shape
    (6, 8, 1)
    """
    return decode_png(path, Path(path).read_bytes())


def decode_png(path: StrPath, data: bytes) -> np.ndarray:
    """The bytes of a PNG file as an image in linear light; `path` names it in errors."""
    with needs("io"):
        from PIL import Image

    try:
        values = png_values(data)
        info = Image.open(BytesIO(data), formats=("PNG",)).info
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not PNG: {error}") from error
    log_profile(path, info)
    gamma = info.get("gamma", _SRGB_GAMMA)
    if "srgb" in info or abs(gamma / _SRGB_GAMMA - 1) < _GAMMA_TOLERANCE:
        return recolor(linear_from_srgb, values).astype(np.float32)
    if not gamma > 0:
        raise ValueError(f"`{path}` must have a gamma above 0, got {gamma}.")
    return recolor(lambda codes: codes ** (1 / gamma), values).astype(np.float32)


def png_values(data: bytes) -> np.ndarray:
    """The codes of a PNG file divided by the largest, height width channel, in [0, 1]."""
    with needs("io"):
        from PIL import Image

    def pixels(layout: str = "") -> np.ndarray:
        image: Any = Image.open(BytesIO(data), formats=("PNG",))
        if layout:
            image.tile = [(*image.tile[0][:3], layout)]
        palette = "RGBA" if "transparency" in image.info else "RGB"
        mode = {"1": "L", "P": palette}.get(image.mode, image.mode)
        array = np.asarray(image.convert(mode) if mode != image.mode else image)
        return array.reshape(*array.shape[:2], -1).astype(np.float64)

    # Of 16-bit RGB, Pillow keeps the high bytes. Told that the byte order is the other one, it
    # keeps the low bytes. 16-bit grey and alpha, read as 8-bit RGBA, has both bytes of both.
    header = Image.open(BytesIO(data), formats=("PNG",))
    layout = str(header.tile[0][3])
    largest = 65535 if "16" in layout else 255
    if layout == "LA;16B":
        high_low = pixels("RGBA")
        codes = 256 * high_low[:, :, ::2] + high_low[:, :, 1::2]
    elif layout in ("RGB;16B", "RGBA;16B"):
        codes = 256 * pixels() + pixels(layout[:-1] + "L")
    else:
        codes = pixels()
    # A file without alpha may declare one colour transparent. Pillow scales greys of 2 and 4
    # bits to 8 bits, but not that colour.
    key = header.info.get("transparency")
    if key is not None and header.mode != "P":
        key = np.atleast_1d(key) * {"L;2": 85, "L;4": 17}.get(layout, 1)
        is_opaque = np.any(codes != key, axis=2, keepdims=True)
        codes = np.concatenate([codes, largest * is_opaque], axis=2)
    return codes / largest
