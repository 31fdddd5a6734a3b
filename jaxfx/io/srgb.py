"""The sRGB curve, between linear light and the numbers that screens want.

The readers and writers of `jaxfx.io` use it, and `jaxfx.scene` for textures and colours.
"""

import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_numpy
from jaxfx._files import StrPath


# How colour profiles name sRGB: as text in version 2 of the format, as UTF-16 in version 4.
_SRGB = (b"sRGB", "sRGB".encode("utf-16-be"))


def srgb_from_linear(linear: Float[ArrayLike, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
    """The sRGB curve: from linear light to the numbers that screens and files take.

    **Arguments:** `linear`: any shape; 0 is black, 1 the screen's white.

    **Returns:** the same type and shape. Outside [0, 1] the curve continues, unclipped.

    **Raises:** `ValueError` for integers.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import io
    >>> print(io.srgb_from_linear(np.array([0.0, 0.18, 1.0])).round(3))
    [0.    0.461 1.   ]

    Source: IEC 61966-2-1, the piecewise curve.
    """
    values, dtype = _floats("srgb_from_linear(linear)", linear)
    power = np.maximum(values, 0.0031308) ** (1 / 2.4)
    curve = np.where(values <= 0.0031308, 12.92 * values, 1.055 * power - 0.055)
    return curve.astype(dtype)


def linear_from_srgb(srgb: Float[ArrayLike, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
    """Linear light from sRGB numbers: the inverse of `srgb_from_linear`.

    **Arguments:** `srgb`: any shape, 0 to 1.

    **Returns:** linear light, the same type and shape, not clipped.

    **Raises:** `ValueError` for integers: divide 8-bit numbers by 255 first.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import io
    >>> print(io.linear_from_srgb(np.array([0, 128, 255]) / 255).round(3))
    [0.    0.216 1.   ]

    Source: IEC 61966-2-1, the piecewise curve.
    """
    values, dtype = _floats("linear_from_srgb(srgb)", srgb)
    power = ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4
    curve = np.where(values <= 0.04045, values / 12.92, power)
    return curve.astype(dtype)


def _floats(name: str, values: Any) -> tuple[np.ndarray, np.dtype]:
    """`values` in float32 or wider, to compute with, and their own type for the result."""
    array = as_numpy(name, values)
    if array.dtype.kind in "biu":
        raise ValueError(
            f"`{name}` must hold floats, 1 for the largest, got {array.dtype}. Divide 8-bit "
            "numbers by 255 and 16-bit ones by 65535."
        )
    return array.astype(np.result_type(array.dtype, np.float32)), array.dtype


def recolor(curve: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """An image, height width channel, with `curve` applied to its colours but not to alpha."""
    colors = 3 if values.shape[2] > 2 else 1
    return np.concatenate([curve(values[:, :, :colors]), values[:, :, colors:]], axis=2)


def log_profile(path: StrPath, info: Mapping[Any, Any]) -> None:
    """Log a warning where a file has a colour profile other than sRGB, which is not applied."""
    profile = info.get("icc_profile") or b""
    if profile and not any(name in profile for name in _SRGB):
        logging.getLogger("jaxfx").warning(
            "`%s` has a colour profile that is not applied: its numbers are taken for sRGB.",
            path,
        )
