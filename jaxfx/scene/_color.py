"""Reads of textures, as stored or undone of their sRGB curve."""

from functools import cache

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Sampler


@cache
def table(dtype: np.dtype, srgb: bool) -> Float[np.ndarray, " code"]:
    """The float32 value of each code of an unsigned type, undone of its curve if `srgb`."""
    largest = np.iinfo(dtype).max
    values = np.arange(largest + 1) / largest
    return (linear_from_srgb(values) if srgb else values).astype(np.float32)


def read_texture(
    texture: UInt8[np.ndarray, "height width 3"] | UInt16[np.ndarray, "height width 3"],
    uv: Float[np.ndarray, "point 2"],
    *,
    srgb: bool,
    sampler: Sampler,
) -> Float[np.ndarray, "point 3"]:
    """Reads at `uv`, after the sampler's transform; sRGB is undone before texels are mixed.

    Texel (row j, column i) has its centre at u = (i + 0.5) / width, v = 1 - (j + 0.5) / height.
    """
    height, width = texture.shape[:2]
    x, left, right = _neighbours(uv[:, 0], width, sampler.wrap[0], sampler.nearest)
    y, top, bottom = _neighbours(1 - uv[:, 1], height, sampler.wrap[1], sampler.nearest)
    texels, value = texture.reshape(-1, 3), table(texture.dtype, srgb)

    def row(start):
        one, other = (value.take(texels.take(start + at, axis=0)) for at in (left, right))
        return one + x * (other - one)

    above, below = row(top * width), row(bottom * width)
    return above + y * (below - above)


def _neighbours(
    coordinate: Float[np.ndarray, " point"], size: int, wrap: str, nearest: bool
) -> tuple[Float[np.ndarray, "point 1"], Int[np.ndarray, " point"], Int[np.ndarray, " point"]]:
    """The second texel's share, and both texels' indices."""
    if wrap == "clamp":
        coordinate = np.clip(coordinate, -1, 2)
    else:  # whole periods off first: what is left keeps its digits
        period = 1 if wrap == "repeat" else 2
        coordinate = coordinate - period * np.floor(coordinate / period)
    position = coordinate * size - (0 if nearest else 0.5)
    first = np.floor(position)
    share = np.zeros_like(position) if nearest else position - first
    index = first.astype(np.intp)
    left, right = (_wrapped(each, size, wrap) for each in (index, index + 1))
    return share.astype(np.float32)[:, None], left, right


def _wrapped(index: Int[np.ndarray, " point"], size: int, wrap: str) -> np.ndarray:
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "repeat":
        return index % size
    index = index % (2 * size)
    return np.minimum(index, 2 * size - 1 - index)
