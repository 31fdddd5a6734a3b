"""What every scatter kernel shares: the sprite of a pixel and its exact coverage."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._numerics import clip01


class Sprites(NamedTuple):
    """Every pixel as a source p and as a destination q of the sums over p of

    `value_p * coverage(q - p; radius_p) * (1 - sharp_q * clip01((leak_p - coc_q) / epsilon))`

    with `sharp_q = 1 - clip01(coc_q / epsilon - 1)`. `value` holds the pixel's channels and a
    one, times its visibility, over its area. `leak` is a background pixel's circle of
    confusion, and -1 for a foreground pixel, whose last factor is thereby 1.
    """

    value: Float[Array, "height width value"]
    radius: Float[Array, "height width"]
    leak: Float[Array, "height width"]
    coc: Float[Array, "height width"]
    epsilon: Float[Array, ""]


# A disc of at most this radius lies inside its own pixel, so its coverage is that of a point.
POINT_RADIUS = 0.5


def reach(max_coc: int | float) -> int:
    """How many pixels away, along an axis, a sprite of diameter `max_coc` covers anything."""
    return max(0, math.ceil(max_coc / 2 - POINT_RADIUS))


def _arc(
    radius: Float[Array, "*shape"], row: Num[Array, ""] | int
) -> tuple[Float[Array, "*shape"], ...]:
    """Where a row's two edges cut the disc: heights and half-chords, and the angle between."""
    row = jnp.asarray(row, radius.dtype)

    def edge(height):
        height = jnp.clip(height, -radius, radius)
        # As a product: where the edge is clamped to the rim it is 0, whatever the rounding. The
        # floor is nothing beside a radius, and keeps the root's derivatives finite.
        square = (radius - height) * (radius + height)
        chord = jnp.sqrt(jnp.maximum(square, math.sqrt(jnp.finfo(radius.dtype).tiny)))
        return height, chord, jnp.arctan2(height, chord)

    below, chord_below, angle_below = edge(row - 0.5)
    above, chord_above, angle_above = edge(row + 0.5)
    return below, chord_below, above, chord_above, angle_above - angle_below


@jax.custom_jvp
def row_half_width(
    radius: Float[Array, "*shape"], row: Num[Array, ""] | int
) -> Float[Array, "*shape"]:
    """Mean half-width of a disc between `row - 1/2` and `row + 1/2` from its centre.

    The integral of `sqrt(radius**2 - t**2)` over the part of those rows inside the disc. Twice
    its sum over all rows is the disc's area, exactly. `radius` is positive. The derivative,
    `radius` times the angle that the row cuts out, is stated: autodiff's form of it cancels at
    the rim.
    """
    below, chord_below, above, chord_above, angle = _arc(radius, row)
    return (above * chord_above - below * chord_below + radius * radius * angle) / 2


@row_half_width.defjvp
def _row_half_width_jvp(primals, tangents):
    radius, row = primals
    *_, angle = _arc(radius, row)
    return row_half_width(radius, row), radius * angle * tangents[0]


@jax.custom_jvp
def coverage(
    half_width: Float[Array, "*shape"], column: Num[Array, ""] | int
) -> Float[Array, "*shape"]:
    """Overlap of the pixel at `column` with the span [-half_width, half_width] of its row."""
    column = jnp.abs(jnp.asarray(column, half_width.dtype))
    return clip01(0.5 - column + half_width) - clip01(0.5 - column - half_width)


@coverage.defjvp
def _coverage_jvp(primals, tangents):
    half_width, column = primals
    distance = jnp.abs(jnp.asarray(column, half_width.dtype))
    near = (half_width >= distance - 0.5) & (half_width < distance + 0.5)
    slope = jnp.where(near, jnp.where(distance == 0, 2, 1), 0).astype(half_width.dtype)
    return coverage(half_width, column), slope * tangents[0]


def leak_rejection(
    leak: Float[Array, "*shape"], coc: Float[Array, "*shape"], epsilon: Float[Array, ""]
) -> Float[Array, "*shape"]:
    """The weight of a sprite of circle of confusion `leak` on a pixel of `coc`."""
    sharp = 1 - clip01(coc / epsilon - 1)
    return 1 - sharp * clip01((leak - coc) / epsilon)
