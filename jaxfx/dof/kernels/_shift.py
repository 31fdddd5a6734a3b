"""Scatter as a gather: for every offset, one shifted multiply-add over the whole image.

No scatter is left in the program. Taps that no sprite reaches are computed all the same, so its
cost is that of the largest sprite at every pixel. The loop's body is rematerialised, so that a
reverse pass keeps no offset's taps.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._loops import scan
from jaxfx.dof.sprites import Sprites, coverage, leak_rejection, row_half_width


def shift(sprites: Sprites, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    value, radius, leak, coc, epsilon = sprites
    height, width = radius.shape
    offsets = jnp.arange(-reach, reach + 1)

    def pad(x, fill):
        margins = [(reach, reach)] * 2 + [(0, 0)] * (x.ndim - 2)
        return jnp.pad(x, margins, constant_values=fill)

    # Nothing lies beyond the frame: a point there has no value.
    value, radius, leak = pad(value, 0), pad(radius, 1), pad(leak, -1)

    def row_of(x, row):
        return jax.lax.dynamic_slice_in_dim(x, reach - row, height, axis=0)

    def column_of(x, column):
        return jax.lax.dynamic_slice_in_dim(x, reach - column, width, axis=1)

    def add_row(sums, row):
        half_width = row_half_width(row_of(radius, row), row)
        row_value, row_leak = row_of(value, row), row_of(leak, row)

        def add_tap(sums, column):
            weight = coverage(column_of(half_width, column), column)
            weight = weight * leak_rejection(column_of(row_leak, column), coc, epsilon)
            return sums + weight[..., None] * column_of(row_value, column), None

        return scan(jax.checkpoint(add_tap), sums, offsets)

    sums = jnp.zeros((height, width, value.shape[-1]), value.dtype)
    return scan(jax.checkpoint(add_row), sums, offsets)[0]
