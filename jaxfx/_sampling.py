"""Where pixels are. The pixel-centre rule of the package lives here alone.

Pixel (row j, column i) covers [i, i + 1) x [j, j + 1); its centre is (i + 0.5, j + 0.5), and
coordinates are always (x, y).
"""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Shaped


def pixel_centers(
    height: int, width: int, dtype: DTypeLike | None = None
) -> Float[Array, "height width 2"]:
    """The coordinates (x, y) of every pixel's centre."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    x = jnp.arange(width, dtype=dtype) + 0.5
    y = jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)


def nearest(
    image: Shaped[Array, "height width ..."], points: Float[Array, "*batch 2"]
) -> Shaped[Array, "..."]:
    """The value of the pixel that covers each point (x, y); the frame's own beyond it."""
    height, width = image.shape[:2]
    x, y = _cell(points[..., 0], width), _cell(points[..., 1], height)
    return image[y, x]


def bilinear(
    image: Float[Array, "height width ..."], points: Float[Array, "*batch 2"]
) -> Float[Array, "..."]:
    """The mean of the four pixels about each point (x, y), the frame's own repeated beyond it.

    Differentiable in both; at a pixel's centre the derivative in the point is the one from
    above. A pixel that is not finite and has no share is left out: it spoils nothing.
    """
    height, width = image.shape[:2]
    corner = jax.lax.stop_gradient(jnp.floor(points - 0.5))
    share = points - 0.5 - corner
    total = jnp.zeros(points.shape[:-1] + image.shape[2:], image.dtype)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x = _cell(corner[..., 0] + dx, width)
        y = _cell(corner[..., 1] + dy, height)
        along = share[..., 0] if dx else 1 - share[..., 0]
        weight = along * (share[..., 1] if dy else 1 - share[..., 1])
        weight = weight.astype(image.dtype).reshape(weight.shape + (1,) * (image.ndim - 2))
        value = image[y, x]
        outside = (weight == 0) & ~jnp.isfinite(value)
        total = total + weight * jnp.where(outside, 0, value)
    return total


def _cell(coordinate: Float[Array, "*batch"], size: int) -> Int[Array, "*batch"]:
    """The index of the row or column that holds a coordinate, the nearest one outside."""
    held = jnp.clip(jax.lax.stop_gradient(coordinate), 0, size - 1)
    return jnp.where(jnp.isnan(held), 0, held).astype(jnp.int32)
