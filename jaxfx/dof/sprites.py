"""The sprite of a pixel and its exact coverage, for every kernel, `fit` and `budget`."""

import functools as ft
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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


@ft.cache
def _segment_polynomial(degree: int) -> tuple[float, ...]:
    """P, lowest power first, in `area(1 - x) = pi / 4 - x**1.5 P(x)` for x in [0, 1].

    `area(s)` is the integral of `sqrt(1 - t**2)` from 0 to s. With `t = 1 - x v` the rest,
    up to 1, is `x**1.5` times the integral of `sqrt(v) sqrt(2 - x v)` over v in [0, 1], whose
    binomial series is summed at the nodes of a Chebyshev fit. The nearest branch point is at
    x = 2, so that the fit's error falls by a factor of 5.8 per degree.
    """
    nodes = (1 - np.cos(np.pi * (np.arange(4 * degree) + 0.5) / (4 * degree))) / 2
    term, values = np.full_like(nodes, math.sqrt(2)), np.zeros_like(nodes)
    for k in range(60):
        values += term / (k + 1.5)
        term *= nodes / 2 * (k - 0.5) / (k + 1)
    series = np.polynomial.Chebyshev.fit(nodes, values, degree, domain=(0, 1))
    return tuple(map(float, series.convert(kind=np.polynomial.Polynomial).coef))


def segment_integral(
    radius: Float[Array, "*shape"], height: Float[Array, ""], slope: bool
) -> list[Float[Array, "*shape"]]:
    """The integral of `sqrt(radius**2 - t**2)` from 0 to `height`, and its slope in the radius.

    For the kernels that visit rows in order: a row's half-width is the difference of two, of
    which one is the next row's, and no arc tangent is left.
    """
    s = height / radius
    s = jnp.where(s < 1, s, 1)
    short = 1 - s
    polynomial = jnp.zeros_like(s)
    for coefficient in reversed(_segment_polynomial(7 if s.dtype == jnp.float32 else 16)):
        polynomial = polynomial * short + coefficient
    root = jnp.sqrt(short)
    area = math.pi / 4 - short * root * polynomial
    value = radius * radius * area
    return [value, radius * (2 * area - s * root * jnp.sqrt(1 + s))] if slope else [value]


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
