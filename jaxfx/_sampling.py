"""Pixel centres, and reads of images at points. The rule of pixel centres is stated here alone.

Pixel (row j, column i) covers [i, i + 1) x [j, j + 1); its centre is (i + 0.5, j + 0.5), and
coordinates are always (x, y).
"""

import functools

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Shaped

from jaxfx._numerics import one_program


def pixel_centers(
    height: int, width: int, dtype: DTypeLike | None = None
) -> Float[Array, "height width 2"]:
    """The coordinates (x, y) of every pixel's centre."""
    return _pixel_centers(height, width, jnp.result_type(float) if dtype is None else dtype)


@functools.partial(one_program, static_argnums=(0, 1, 2))
def _pixel_centers(height: int, width: int, dtype: DTypeLike) -> Float[Array, "height width 2"]:
    x = jnp.arange(width, dtype=dtype) + 0.5
    y = jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)


@one_program
def nearest(
    image: Shaped[Array, "height width ..."], points: Float[Array, "*batch 2"]
) -> Shaped[Array, "..."]:
    """The value of the pixel that covers each point (x, y); outside, the nearest pixel's."""
    height, width = image.shape[:2]
    x, y = _cell(points[..., 0], width), _cell(points[..., 1], height)
    return image[y, x]


@one_program
def bilinear(
    image: Float[Array, "height width ..."], points: Float[Array, "*batch 2"]
) -> Float[Array, "..."]:
    """Bilinear interpolation at each point (x, y); outside, the border pixels are repeated.

    Differentiable in both; at a pixel's centre the derivative in the point is the one from
    above. A pixel of weight 0 that is not finite is left out: it spoils nothing.
    """
    height, width = image.shape[:2]
    corner = jax.lax.stop_gradient(jnp.floor(points - 0.5))
    fraction = points - 0.5 - corner
    total = jnp.zeros(points.shape[:-1] + image.shape[2:], image.dtype)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x = _cell(corner[..., 0] + dx, width)
        y = _cell(corner[..., 1] + dy, height)
        weight_x = fraction[..., 0] if dx else 1 - fraction[..., 0]
        weight = weight_x * (fraction[..., 1] if dy else 1 - fraction[..., 1])
        weight = weight.astype(image.dtype).reshape(weight.shape + (1,) * (image.ndim - 2))
        value = image[y, x]
        is_unusable = (weight == 0) & ~jnp.isfinite(value)
        total = total + weight * jnp.where(is_unusable, 0, value)
    return total


def _cell(coordinate: Float[Array, "*batch"], size: int) -> Int[Array, "*batch"]:
    """The index of the row or column that holds a coordinate; outside, the nearest; NaN, 0."""
    clipped = jnp.clip(jax.lax.stop_gradient(coordinate), 0, size - 1)
    return jnp.where(jnp.isnan(clipped), 0, clipped).astype(jnp.int32)
