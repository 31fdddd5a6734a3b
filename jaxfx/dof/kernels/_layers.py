"""The sums of `layered`: slices of sprites, composited at every pixel from front to back.

A sprite between two slices is divided between them. The slices of a sheet come after all slices
of the sheet before: its sprites are hidden from the centre of the lens. On a CPU slices are
painted one by one, and once more each by the adjoint; on an accelerator in groups.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._loops import cond, scan
from jaxfx._numerics import clip01
from jaxfx._platform import in_groups
from jaxfx._xla import sum_planes
from jaxfx.dof.kernels._adjoint import Program, with_adjoint
from jaxfx.dof.kernels._compositing import (
    Filling,
    Record,
    allowance,
    begin_reading,
    fill,
    nothing_filled,
    read_slice,
    recorded,
)
from jaxfx.dof.kernels._layer_rows import SHEET_ROWS
from jaxfx.dof.kernels._slices import (
    APART,
    SLICES,
    Extent,
    Grid,
    Sheets,
    across_of,
    ordered,
    share_of,
)
from jaxfx.dof.kernels._span_painter import DIRECTIONS
from jaxfx.dof.sprites import POINT_RADIUS, row_half_width


def composited(extent: Extent, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    """Light per pixel of the frame and, last, the share of the aperture that it covers.

    Then the same once more, each part of it weighted by how much was filled when it arrived.
    """
    return _composited(extent, sheets)


def _forward(extent: Extent, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    filling = _filled(extent, sheets)
    return jnp.concatenate([filling.light, filling.late])


def _recorded(
    extent: Extent, sheets: Sheets
) -> tuple[Float[Array, "twice_value height width"], Record]:
    return recorded(_filled(extent, sheets))


def _filled(extent: Extent, sheets: Sheets) -> Filling:
    grid = Grid(extent.reach, sheets)
    discs = grid.discs(sheets)

    def add(index, is_held, state):
        return fill(index, grid.paint(index, is_held, discs), state)

    return grid.each_slice(discs, add, nothing_filled(extent, sheets))


def _tangents(
    extent: Extent, sheets: Sheets, sheets_dots: Sheets
) -> Float[Array, "direction twice_value height width"]:
    grid = Grid(extent.reach, sheets)
    discs, dots = grid.discs(sheets), grid.dots(sheets_dots)
    values, directions = grid.values, dots.shape[2]

    def add(index, is_held, state):
        light, light_dots, late_dots = state
        painted = grid.paint(index, is_held, discs, dots)
        arriving, arriving_dots = painted[:values], painted[values:].reshape(light_dots.shape)
        allowed, weight, full = allowance(arriving, light)
        # Where the lens gets full, the share that is filled stays: its tangent is 0.
        filled_dot = light_dots[:, -1] + allowed[None] * arriving_dots[:, -1]
        share = jnp.where(full, arriving[-1], 1)
        allowed_dot = jnp.where(full[None], -filled_dot / share[None], 0)
        added = allowed[None] * arriving
        added_dots = allowed[None, None] * arriving_dots + allowed_dot[:, None] * arriving[None]
        weight_dot = light_dots[:, -1] + added_dots[:, -1] / 2
        late_dots = late_dots + weight[None, None] * added_dots
        late_dots = late_dots + weight_dot[:, None] * added[None]
        return light + added, light_dots + added_dots, late_dots

    nothing = jnp.zeros(grid.shape, sheets.value.dtype)
    no_dots = jnp.zeros((directions, *grid.shape), sheets.value.dtype)
    _, *tangents = grid.each_slice(discs, add, (nothing, no_dots, no_dots))
    return jnp.concatenate(tangents, axis=1)


def _adjoint(
    extent: Extent,
    sheets: Sheets,
    bar: Float[Array, "twice_value height width"],
    record: Record,
) -> Sheets:
    grid = Grid(extent.reach, sheets)
    reading = begin_reading(record, bar)
    discs = grid.discs(sheets)

    def read(index, is_held, state):
        bars, *carry = state
        arriving = grid.paint(index, is_held, discs)
        arriving_bar, carry = read_slice(reading, index, arriving, tuple(carry))
        return grid.read_back(index, is_held, discs, arriving_bar, bars), *carry

    return grid.planes(grid.each_slice(discs, read, (jnp.zeros_like(discs), *reading.start))[0])


def plain(extent: Extent, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    """The same by dense sums over all offsets, which JAX can differentiate again."""
    reach = extent.reach
    height, width = (n - 2 * reach for n in sheets.radius.shape[-2:])
    across = across_of(reach)
    pad = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(across - reach, across - reach)])
    value, radius, tilt, place = map(pad, sheets)
    radius, place = jnp.where(radius > 0, radius, POINT_RADIUS), ordered(place)

    def cut(planes, row, column):
        planes = jax.lax.dynamic_slice_in_dim(planes, reach - row, height, axis=-2)
        return jax.lax.dynamic_slice_in_dim(planes, across - column, width, axis=-1)

    def arriving(index):
        light = value * share_of(place - index.astype(place.dtype))[:, None]

        def add_row(sums, row):
            span = row_half_width(radius, row)
            moved = tilt[:, 0] * span * span / 3
            row_light = light * (1 + tilt[:, 1] * row.astype(radius.dtype))[:, None]

            def add_tap(sums, column):
                there = lambda planes: cut(planes, row, column)
                edge = 0.5 - column.astype(radius.dtype)
                end, start = there(moved) + there(span), there(moved) - there(span)
                cover = clip01(end + edge) - clip01(start + edge)
                return sums + sum_planes(cover[:, None] * there(row_light)), None

            return scan(jax.checkpoint(add_tap), sums, jnp.arange(-across, across + 1))

        nothing = jnp.zeros((value.shape[1], height, width), value.dtype)
        rows = jnp.arange(-reach, reach + 1)
        return scan(jax.checkpoint(add_row), nothing, rows)[0]

    def add(state, index):
        light, late = state
        some = (share_of(place - index.astype(place.dtype)) > 0).any()
        arrived = cond(some, arriving, lambda _: jnp.zeros_like(light), index)
        allowed, weight, _ = allowance(arrived, light)
        added = allowed[None] * arrived
        return (light + added, late + weight[None] * added), None

    nothing = jnp.zeros((value.shape[1], height, width), value.dtype)
    slices = jnp.arange(-SLICES, SLICES + 1 + (len(value) - 1) * APART)
    return jnp.concatenate(scan(jax.checkpoint(add), (nothing, nothing), slices)[0])


_BY_SPANS = Program(_forward, in_groups(_tangents, DIRECTIONS), _adjoint, _recorded)
_composited = with_adjoint(_BY_SPANS, plain, SHEET_ROWS)
