"""Scatter by sprites of any convex shape, by plain loops over rows that JAX can differentiate.

A row of a sprite is a span between two ends; `jaxfx.dof.iris` gives them. `taps` visits every
pixel of the largest sprite, `painted` writes the ends alone and fills the spans by a running
sum. The loops' bodies are rematerialised: a reverse pass keeps no row. One program serves CPUs
and accelerators.

What they do not do well: every row of the largest sprite is visited for every pixel, whatever
the image holds; a running sum in float32 leaves about 1e-7 of a highlight along its row.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import clip01
from jaxfx.dof.iris import Cut, Outline, cuts, moved, span
from jaxfx.dof.kernels._span_painter import filled
from jaxfx.dof.kernels._taps import UNCOUPLED
from jaxfx.dof.sprites import Sprites, leak_rejection, reach


class Shaped(NamedTuple):
    """Sprites and their shape.

    - `side`: per sprite, 1 for the outline as it is, -1 for it turned by half a turn.
    """

    sprites: Sprites
    side: Float[Array, "height width"]
    outline: Outline


def _ends(
    outline: Outline,
    radius: Float[Array, "*shape"],
    side: Float[Array, "*shape"],
    cut: Cut,
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Where the span of each sprite begins and ends in a row, from its centre, in pixels."""
    center, half_width = span(outline, radius, side, cut)
    return center - half_width, center + half_width


def taps(shaped: Shaped, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels, offset by offset."""
    (value, radius, leak, coc, epsilon), side, outline = shaped
    height, width = radius.shape
    offsets = jnp.arange(-reach, reach + 1)

    def pad(x, fill):
        margins = [(reach, reach)] * 2 + [(0, 0)] * (x.ndim - 2)
        return jnp.pad(x, margins, constant_values=fill)

    # Nothing lies beyond the frame: a point there has no value.
    value, radius, leak, side = pad(value, 0), pad(radius, 1), pad(leak, -1), pad(side, 1)
    margins = (reach, reach), (reach, reach)
    outline = moved(outline, lambda x: jnp.pad(x, [*[(0, 0)] * (x.ndim - 2), *margins]))

    def row_of(x, row, axis=0):
        return jax.lax.dynamic_slice_in_dim(x, reach - row, height, axis=axis)

    def column_of(x, column):
        return jax.lax.dynamic_slice_in_dim(x, reach - column, width, axis=1)

    def add_row(sums, cut):
        row = cut.row
        here = moved(outline, lambda x: row_of(x, row, axis=x.ndim - 2))
        start, end = _ends(here, row_of(radius, row), row_of(side, row), cut)
        row_value, row_leak = row_of(value, row), row_of(leak, row)
        if cut.weight is not None:
            row_value = cut.weight * row_value

        def add_tap(sums, column):
            edge = 0.5 - column.astype(start.dtype)
            weight = clip01(column_of(end, column) + edge)
            weight = weight - clip01(column_of(start, column) + edge)
            weight = weight * leak_rejection(column_of(row_leak, column), coc, epsilon)
            return sums + weight[..., None] * column_of(row_value, column), None

        return jax.lax.scan(jax.checkpoint(add_tap), sums, offsets)

    sums = jnp.zeros((height, width, value.shape[-1]), value.dtype)
    return jax.lax.scan(jax.checkpoint(add_row), sums, cuts(outline, reach))[0]


def painted(shaped: Shaped, far: int, near: int) -> Float[Array, "height width value"]:
    """The same sums by running sums along rows.

    Background of less than three epsilons goes by `taps`, as far as `near` pixels; the weight
    of all others depends on the target alone.
    """
    (value, radius, leak, coc, epsilon), side, outline = shaped
    is_coupled = (leak >= 0) & (coc < UNCOUPLED * epsilon)
    coupled = jnp.where(is_coupled[..., None], value, 0)
    close = Sprites(coupled, jnp.where(is_coupled, radius, 1), leak, coc, epsilon)
    sums = taps(Shaped(close, side, outline), near)
    rest = jnp.where(is_coupled[..., None], 0, value)
    layer = (leak >= 0).astype(int)
    before, behind = _paint(rest, radius, side, layer, outline, far)
    return sums + before + clip01(coc / epsilon - 1)[..., None] * behind


def near_reach(epsilon: float, max_coc: float) -> int:
    """How far the sprites go that `painted` hands to `taps`, in pixels."""
    return reach(min(max_coc, UNCOUPLED * epsilon))


def _paint(value, radius, side, layer, outline, far):
    """The sums of the sprites of each of two layers, by the steps of `_span_painter`."""
    height, width, values = value.shape
    rows, columns = height + 2 * far, width + 2 * far + 2
    y = jnp.arange(height)[:, None] + layer * rows + far
    x = jnp.arange(width, dtype=radius.dtype)[None] + (far + 1.5)
    flat = value.reshape(-1, values)

    def add_row(steps, cut):
        start, end = _ends(outline, radius, side, cut)
        light = flat if cut.weight is None else cut.weight * flat
        for edge, sign in ((start, 1), (end, -1)):
            place = x + edge
            cell = jnp.floor(place)
            part = (place - cell).reshape(-1, 1)
            at = ((y + cut.row) * columns + cell.astype(int)).reshape(-1)
            step = sign * jnp.concatenate([light, part * light], axis=1)
            steps = steps.at[at].add(step, mode="clip")
        return steps, None

    steps = jnp.zeros((2 * rows * columns, 2 * values), value.dtype)
    steps = jax.lax.scan(jax.checkpoint(add_row), steps, cuts(outline, far))[0]
    sums = filled(steps.reshape(2, rows, columns, 2 * values), axis=2)
    return sums[:, far:, far + 1 :][:, :height, :width]
