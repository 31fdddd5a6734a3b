"""The plain reading of the paper: every tap of every sprite, written out and summed.

The oracle of the other kernels. Its memory is pixels times taps, so it is for small images.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx.dof.sprites import Sprites, coverage, leak_rejection, row_half_width


def _indicator(
    radius: Float[Array, "*shape"], row: Num[Array, ""], column: Num[Array, ""]
) -> Float[Array, "*shape"]:
    """The paper's own coverage: 1 where a pixel's centre lies inside the disc."""
    return (row * row + column * column <= radius * radius).astype(radius.dtype)


def _area(
    radius: Float[Array, "*shape"], row: Num[Array, ""], column: Num[Array, ""]
) -> Float[Array, "*shape"]:
    return coverage(row_half_width(radius, row), column)


COVERAGES = {"area": _area, "indicator": _indicator}


def segment_sum(
    sprites: Sprites, reach: int, coverage: str = "area"
) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    value, radius, leak, coc, epsilon = sprites
    height, width = radius.shape
    side = jnp.arange(-reach, reach + 1)
    rows, columns = (offset.reshape(-1) for offset in jnp.meshgrid(side, side))
    to_row = jnp.arange(height)[None, :, None] + rows[:, None, None]
    to_column = jnp.arange(width)[None, None, :] + columns[:, None, None]
    inside = (to_row >= 0) & (to_row < height) & (to_column >= 0) & (to_column < width)
    target = jnp.where(inside, to_row * width + to_column, height * width)

    cover = jax.vmap(COVERAGES[coverage], in_axes=(None, 0, 0))(
        radius, rows.astype(radius.dtype), columns.astype(radius.dtype)
    )
    there = coc.reshape(-1)[jnp.minimum(target, height * width - 1)]
    weight = cover * leak_rejection(jnp.broadcast_to(leak, there.shape), there, epsilon)
    taps = weight[..., None] * value[None]
    sums = jax.ops.segment_sum(
        taps.reshape(-1, value.shape[-1]), target.reshape(-1), num_segments=height * width + 1
    )
    return sums[:-1].reshape(height, width, value.shape[-1])
