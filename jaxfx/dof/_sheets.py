"""The sums of `layered`: slices of sprites, composited at every pixel from front to back.

What a slice sums to at a pixel is light and the share of the lens that sees it. Slices fill the
lens of each pixel from the front: each takes what room is left, and none is left behind what
fills it all. A sprite between two slices is divided. The slices of a sheet come after all of
the sheet before: its sprites are hidden to the centre of the lens, and what is not is known
better.

What is left free has the mean colour of what arrived, which counts for more the more was filled
before it.

The adjoint keeps no slice but paints each once more. Of a pixel it knows the slice that filled
it, the share that this one got, and its colour: slices in front count in full and, by the room
they take, against that colour.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._numerics import clip01, sum_planes
from jaxfx.dof._adjoint import with_adjoint
from jaxfx.dof._slices import APART, SLICES, Grid, Sheets, across_of, ordered, share_of
from jaxfx.dof._sprites import POINT_RADIUS, row_half_width


# A slice after all others.
_NEVER = 2**30
# A lens is full to so many units of rounding.
_ROUNDING = 32
# What arrives at an empty lens has this weight for the rest, at a full one 1 more.
_FIRST = 0.1


def composited(reach: int, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    """What fills the lens of each pixel of the frame: light and, last, how much it fills.

    Then the same once more, each part of it weighted by how much was filled when it arrived.
    """
    return _composited(reach, sheets)


class _Filling(NamedTuple):
    """A lens as slice by slice fills it: with what, the same weighted, and which filled it up.

    Of the slice that did: its number, what arrived of it, and the part that found room.
    """

    light: Float[Array, "value height width"]
    late: Float[Array, "value height width"]
    last: Int[Array, "height width"]
    arrived: Float[Array, "value height width"]
    part: Float[Array, "height width"]


def _forward(reach: int, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    filling = _filled(Grid(reach, sheets), sheets)
    return jnp.concatenate([filling.light, filling.late])


def _filled(grid: Grid, sheets: Sheets) -> _Filling:
    discs = grid.discs(sheets)

    def add(index, order, count, state):
        arriving = grid.paint(index, order, count, discs)
        allowed, weight, full = _allowed(arriving, state.light)
        # Once.
        fills = full & (state.last == _NEVER)
        found = allowed[None] * arriving
        return _Filling(
            state.light + found,
            state.late + weight[None] * found,
            jnp.where(fills, index, state.last),
            jnp.where(fills[None], arriving, state.arrived),
            jnp.where(fills, allowed, state.part),
        )

    shape = grid.height, grid.width
    zero = jnp.zeros(shape, sheets.value.dtype)
    nothing = jnp.zeros((grid.values, *shape), zero.dtype)
    state = _Filling(nothing, nothing, jnp.full(shape, _NEVER), nothing, zero)
    return grid.each_slice(discs, add, state)


def _tangent(
    reach: int, sheets: Sheets, dot: Sheets
) -> Float[Array, "twice_value height width"]:
    grid = Grid(reach, sheets)
    discs, dots = grid.discs(sheets), grid.discs(sheets, dot)

    def add(index, order, count, state):
        light, light_dot, late_dot = state
        arriving, arriving_dot = jnp.split(grid.paint(index, order, count, discs, dots), 2)
        allowed, weight, full = _allowed(arriving, light)
        taken = light_dot[-1] + allowed * arriving_dot[-1]
        allowed_dot = jnp.where(full, -taken / jnp.where(full, arriving[-1], 1), 0)
        found = allowed[None] * arriving
        found_dot = allowed[None] * arriving_dot + allowed_dot[None] * arriving
        weight_dot = light_dot[-1] + found_dot[-1] / 2
        late_dot = late_dot + weight[None] * found_dot + weight_dot[None] * found
        return light + found, light_dot + found_dot, late_dot

    nothing = jnp.zeros((grid.values, grid.height, grid.width), sheets.value.dtype)
    _, *found = grid.each_slice(discs, add, (nothing, nothing, nothing))
    return jnp.concatenate(found)


def _adjoint(
    reach: int, sheets: Sheets, bar: Float[Array, "twice_value height width"]
) -> Sheets:
    grid = Grid(reach, sheets)
    filling = _filled(grid, sheets)
    discs = grid.discs(sheets)
    bar, late_bar = jnp.split(bar, 2)
    along = lambda bar, light: sum_planes(bar * light)
    # The slice that fills a lens gives it as much of its colour as there is room.
    arrived, part = filling.arrived, filling.part
    color = arrived / jnp.where(part > 0, arrived[-1], 1)[None]
    room = part * arrived[-1]
    weight_last = filling.light[-1] - room / 2 + _FIRST
    late_worth = along(late_bar, color)
    worth = along(bar, color) + weight_last * late_worth
    # What takes room takes it from that, and makes all that comes later count for more.
    ahead = along(late_bar, filling.light) - room * late_worth / 2

    def read(index, order, count, state):
        bars, filled, ahead = state
        arriving = grid.paint(index, order, count, discs)
        before, last = index < filling.last, index == filling.last
        late = along(late_bar, arriving)
        weight = jnp.where(before, filled + arriving[-1] / 2 + _FIRST, weight_last)
        seen = bar + weight[None] * late_bar
        seen = seen.at[-1].add(jnp.where(before, ahead - late / 2, 0) - worth)
        counted = jnp.where(before, 1, jnp.where(last, part, 0))
        bars = grid.read_back(index, order, count, discs, counted[None] * seen, bars)
        took = lambda x: jnp.where(before, x, 0)
        return bars, filled + took(arriving[-1]), ahead - took(late)

    nothing = jnp.zeros_like(filling.part)
    bars = grid.each_slice(discs, read, (jnp.zeros_like(discs), nothing, ahead))[0]
    return grid.planes(bars)


def plain(reach: int, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    """The same by dense sums over all offsets, which JAX can differentiate again."""
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

            return jax.lax.scan(jax.checkpoint(add_tap), sums, jnp.arange(-across, across + 1))

        nothing = jnp.zeros((value.shape[1], height, width), value.dtype)
        rows = jnp.arange(-reach, reach + 1)
        return jax.lax.scan(jax.checkpoint(add_row), nothing, rows)[0]

    def add(state, index):
        light, late = state
        some = (share_of(place - index.astype(place.dtype)) > 0).any()
        arrived = jax.lax.cond(some, arriving, lambda _: jnp.zeros_like(light), index)
        allowed, weight, _ = _allowed(arrived, light)
        found = allowed[None] * arrived
        return (light + found, late + weight[None] * found), None

    nothing = jnp.zeros((value.shape[1], height, width), value.dtype)
    slices = jnp.arange(-SLICES, SLICES + 1 + (len(value) - 1) * APART)
    return jnp.concatenate(jax.lax.scan(jax.checkpoint(add), (nothing, nothing), slices)[0])


_composited = with_adjoint(_forward, _tangent, _adjoint, plain)


def _allowed(
    arriving: Float[Array, "value height width"], light: Float[Array, "value height width"]
) -> tuple[Float[Array, "height width"], Float[Array, "height width"], Bool[Array, "*size"]]:
    """The part of a slice that finds room behind what filled the lens; its weight for what
    stays free, by how much is filled at the mean; and where not all of it finds room.
    """
    filled, share = light[-1], arriving[-1]
    # Not less than nothing by rounding.
    room = 1 - _ROUNDING * jnp.finfo(light.dtype).eps - filled
    room = jnp.where(room > 0, room, 0)
    full = share > room
    allowed = jnp.where(full, room / jnp.where(full, share, 1), 1)
    return allowed, filled + allowed * share / 2 + _FIRST, full
