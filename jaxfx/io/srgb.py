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


# How a colour profile names sRGB, in its two versions.
_SRGB = (b"sRGB", "sRGB".encode("utf-16-be"))


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


def recolor(curve: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """`curve` on the colours of an image, not on its alpha."""
    colors = 3 if values.shape[2] > 2 else 1
    return np.concatenate([curve(values[:, :, :colors]), values[:, :, colors:]], axis=2)


def log_profile(path: StrPath, facts: Mapping[Any, Any]) -> None:
    """Say that a colour profile is not heeded, where it is another than sRGB."""
    profile = facts.get("icc_profile") or b""
    if profile and not any(name in profile for name in _SRGB):
        logging.getLogger("jaxfx").warning(
            "`%s` has a colour profile that is not heeded: its numbers are taken for sRGB.",
            path,
        )
