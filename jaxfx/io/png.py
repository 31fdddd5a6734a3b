"""PNG files, and the sRGB curve that screens want."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfx._checks import as_numpy
from jaxfx._extras import needs
from jaxfx._files import StrPath, check_suffix, write_whole
from jaxfx.io._pixels import log_profile, png_values


# The gamma that files give to say sRGB.
_SRGB_GAMMA = 1 / 2.2


def srgb_from_linear(linear: Float[ArrayLike, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The sRGB curve: from linear light to what a screen is sent.

    **Arguments:** `linear`: any shape; 0 is black, 1 the screen's white.

    **Returns:** the same type and shape, not clipped: outside [0, 1] the curve goes on.

    **Raises:** `ValueError` for integers.

    **Gradient:** none; the host side.

    Source: IEC 61966-2-1, the piecewise curve.
    """
    values, dtype = _floats("srgb_from_linear(linear)", linear)
    power = np.maximum(values, 0.0031308) ** (1 / 2.4)
    curve = np.where(values <= 0.0031308, 12.92 * values, 1.055 * power - 0.055)
    return curve.astype(dtype)


def linear_from_srgb(srgb: Float[ArrayLike, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The inverse of `srgb_from_linear`.

    **Arguments:** `srgb`: any shape, 0 to 1.

    **Returns:** linear light, the same type and shape, not clipped.

    **Raises:** `ValueError` for integers: 8-bit numbers are to be divided by 255 first.

    **Gradient:** none; the host side.

    Source: IEC 61966-2-1, the piecewise curve.
    """
    values, dtype = _floats("linear_from_srgb(srgb)", srgb)
    power = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
    curve = np.where(values <= 0.04045, values / 12.92, power)
    return curve.astype(dtype)


def _floats(name: str, values: Any) -> tuple[np.ndarray, np.dtype]:
    """Numbers to compute a curve of, in float32 at least, and their own type."""
    array = as_numpy(name, values)
    if array.dtype.kind in "biu":
        raise ValueError(
            f"`{name}` must hold floats, 1 for the largest, got {array.dtype}. Divide 8-bit "
            "numbers by 255 and 16-bit ones by 65535."
        )
    return array.astype(np.result_type(array.dtype, np.float32)), array.dtype


def write_png(path: StrPath, image: Float[ArrayLike, "height width channel"]) -> None:
    """Write an 8-bit sRGB picture, whole or not at all.

    **Arguments:**

    - `path`: the file; an old one is replaced once the new one is complete.
    - `image`: height width channel, linear: grey, grey and alpha, RGB or RGBA. Values are
      clipped to [0, 1] and rounded to the nearest of 256; NaN becomes 0. Alpha is stored
      linear.

    **Raises:** `ValueError` for anything but an image of 1 to 4 channels, or a name that ends
    in another suffix than `.png`; `OSError` where the folder does not exist or can't be
    written.

    **Gradient:** none; the host side.
    """
    with needs("io"):
        from PIL import Image

    check_suffix("write_png(path)", path, ".png")
    array = np.asarray(image)
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
    """Read a PNG image of colours into linear light.

    An image of depth is none of colours: `read_depth` gives its numbers as they are.

    **Arguments:** `path`: a PNG file. Its numbers are taken for sRGB, or undone of the gamma
    that the file names; alpha is linear. A colour profile in the file is not heeded, which is
    logged where it is not sRGB.

    **Returns:** float32, height width channel, in [0, 1]: grey, grey and alpha, RGB or RGBA,
    as in the file, 16 bits in full; a palette is looked up, and a colour that the file calls
    transparent has alpha 0.

    **Raises:** `ValueError` that names the file where it is damaged or not PNG; `OSError` where
    it can't be opened.

    **Gradient:** none; the host side.
    """
    return decode_png(path, Path(path).read_bytes())


def decode_png(path: StrPath, data: bytes) -> np.ndarray:
    """The image of a PNG file; `path` is for errors."""
    with needs("io"):
        from PIL import Image

    try:
        values = png_values(data)
        facts = Image.open(BytesIO(data), formats=("PNG",)).info
    except Exception as error:
        raise ValueError(f"`{path}` is damaged or not PNG: {error}") from error
    log_profile(path, facts)
    gamma = facts.get("gamma", _SRGB_GAMMA)
    if "srgb" in facts or abs(gamma / _SRGB_GAMMA - 1) < 0.05:
        return recolor(linear_from_srgb, values).astype(np.float32)
    if not gamma > 0:
        raise ValueError(f"`{path}` must have a gamma above 0, got {gamma}.")
    return recolor(lambda codes: codes ** (1 / gamma), values).astype(np.float32)


def recolor(curve: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """`curve` on the colours of an image, not on its alpha."""
    colors = 3 if values.shape[2] > 2 else 1
    return np.concatenate([curve(values[:, :, :colors]), values[:, :, colors:]], axis=2)
