"""Reads of byte textures, as stored or undone of their sRGB curve."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfx.io import linear_from_srgb


_BYTES = np.arange(256) / 255
LINEAR = _BYTES.astype(np.float32)
SRGB = linear_from_srgb(_BYTES).astype(np.float32)


def read_texture(
    texture: UInt8[np.ndarray, "height width 3"],
    uv: Float[np.ndarray, "point 2"],
    curve: Float[np.ndarray, "256"],
) -> Float[np.ndarray, "point 3"]:
    """Bilinear reads with repeat, of the values that `curve` gives the bytes.

    Texel (row j, column i) has its centre at u = (i + 0.5) / width, v = 1 - (j + 0.5) / height.
    """
    height, width = texture.shape[:2]
    x, left, right = _neighbours(uv[:, 0], width)
    y, top, bottom = _neighbours(1 - uv[:, 1], height)
    texels = texture.reshape(-1, 3)

    def row(start):
        one, other = (curve.take(texels.take(start + at, axis=0)) for at in (left, right))
        return one + x * (other - one)

    above, below = row(top * width), row(bottom * width)
    return above + y * (below - above)


def _neighbours(
    coordinate: Float[np.ndarray, " point"], size: int
) -> tuple[Float[np.ndarray, "point 1"], Int[np.ndarray, " point"], Int[np.ndarray, " point"]]:
    """The second texel's share, and both texels' indices."""
    position = (coordinate - np.floor(coordinate)) * size - 0.5
    first = np.floor(position)
    share = (position - first).astype(np.float32)[:, None]
    index = first.astype(np.intp)
    return share, index % size, (index + 1) % size
