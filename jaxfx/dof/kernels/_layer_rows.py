"""The sums of `layered` by rows of offsets, several slices at a time, over the whole image.

For devices on which a launch costs more than what it computes. A group of slices is summed in
one sweep over the offsets that its sprites reach, then composited slice by slice. The taps of
several rows of offsets are a loop inside one kernel (`_windows`). The adjoint sweeps over the
same offsets and is owned by the sources: nothing is scattered. If the threshold is concrete,
the number of slices is known when the program is compiled; else the host looks at the data.

What it does not do well: every tap of a group's largest sprite is computed at every pixel for
every slice of the group, whatever the image holds.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from jaxfx._loops import fori_loop
from jaxfx._numerics import clip01
from jaxfx._platform import one_by_one
from jaxfx.dof.kernels._adjoint import Program
from jaxfx.dof.kernels._compositing import (
    Record,
    begin_reading,
    fill,
    lit,
    nothing_filled,
    read_slice,
    recorded,
)
from jaxfx.dof.kernels._slices import APART, Extent, Sheets, across_of, share_of, share_slope_of
from jaxfx.dof.kernels._taps import inside
from jaxfx.dof.kernels._windows import in_turns, summed, together, windows
from jaxfx.dof.sprites import segment_integral


# Slices per group: their sums stay in registers. With more, the coverage of a tap is computed
# for fewer groups, but the sums take more memory.
GROUP = 3
# Pixels. A reach up to this is not made shorter for slices near the focus: that would save
# less time than a further program takes to compile.
_SHORT = 8
# The most rows of offsets at a time. More are fewer launches, but where each sprite's span ends
# is kept for every one of them.
ROWS = 8
# The same of the adjoint, which keeps more for each row.
_ROWS_BACK = 4


@ft.partial(jax.custom_jvp)
def _half_width(radius: Float[Array, "*size"], row: Num[Array, ""]) -> Float[Array, "*size"]:
    """Mean half-width of each disc in a row of pixels, `row` rows from its centre."""
    return _half_width_and_slope(radius, row, slope=False)[0]


def _half_width_and_slope(radius, row, *, slope):
    distance = jnp.abs(row).astype(radius.dtype)
    upper = segment_integral(radius, distance + 0.5, slope)
    lower = segment_integral(radius, jnp.abs(distance - 0.5), slope)
    sign = jnp.sign(distance - 0.5)  # half of the middle row lies below its middle
    return [x - sign * y for x, y in zip(upper, lower, strict=True)]


@_half_width.defjvp
def _(primals, tangents):
    width, slope = _half_width_and_slope(*primals, slope=True)
    return width, slope * tangents[0]


def _groups(extent: Extent, slices: int) -> list[tuple[int, int, int]]:
    """Runs of like groups of `GROUP` slices from the front: first slice, groups, and reach.

    Slices near the focus reach less far. A reach is the largest, or a half, a quarter of it and
    so on, down to `_SHORT`: each other one would be a program of its own to compile. Slices of
    the last group that lie beyond all sprites are empty.
    """
    # Largest thickness of a slice, in pixels of radius.
    thick = extent.max_coc / 2 / max(slices - 1, 1)
    runs = []
    for first in range(-slices, slices + 1, GROUP):
        last = first + GROUP - 1
        needed, reach = extent.reach_of(thick * (max(-first, last) + 1)), extent.reach
        while reach > _SHORT and needed <= reach // 2:
            reach = reach // 2
        if runs and runs[-1][2] == reach:
            start, groups, _ = runs.pop()
            runs.append((start, groups + 1, reach))
        else:
            runs.append((first, 1, reach))
    return runs


def _each_group(
    extent: Extent,
    sheets: Sheets,
    visit: Callable[..., Any],
    state: Any,
) -> Any:
    """Fold `visit(sheet, number, first, arriving, reach, state)` over groups, from the front.

    `first` is the number of the group's first slice, `arriving` are the sums of each of them.
    """
    for number in range(len(sheets.radius)):
        sheet = jax.tree.map(lambda x, n=number: x[n], sheets)
        if extent.slices is None:
            first = jnp.floor(sheet.place.min()).astype(int)
            slices = jnp.ceil(sheet.place.max()).astype(int) - first + 1
            runs = [(first, -(-slices // GROUP), extent.reach)]
        else:
            runs = _groups(extent, extent.slices)
        wide = _padded(extent, sheet)
        for start, groups, reach in runs:

            def add_group(k, state, run=(start, reach), wide=wide, n=number):
                start, reach = run
                first = start + k * GROUP
                arriving = _arriving(extent, wide, first, reach)
                return visit(_cut(extent, wide), n, first, arriving, reach, state)

            # One run after the other, or all of them would take memory at once.
            wide, state = jax.lax.optimization_barrier((wide, state))
            state = fori_loop(0, groups, add_group, state)
    return state


def _padded(extent: Extent, sheet: Sheets) -> Sheets:
    """A sheet as wide as any offset goes, and as high as the last turn."""
    beside = across_of(extent.reach) - extent.reach
    pad = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, _below(extent)), (beside,) * 2])
    radius = pad(sheet.radius)
    value = pad(jnp.where(sheet.value[-1:] > 0, sheet.value, 0))
    return Sheets(value, jnp.where(radius > 0, radius, 1), pad(sheet.tilt), pad(sheet.place))


def _cut(extent: Extent, wide: Sheets) -> Sheets:
    """The sheet from which `_padded` made `wide`.

    It is read out of `wide`, so that only one of the two takes memory.
    """
    beside = across_of(extent.reach) - extent.reach
    cut = lambda x: x[..., : x.shape[-2] - _below(extent), beside : x.shape[-1] - beside]
    return jax.tree.map(cut, wide)


def _below(extent: Extent) -> int:
    """The most rows of offsets that only fill up a turn."""
    return in_turns(2 * extent.reach + 1, ROWS)[0]


# Compiled: groups of one size and reach, before and behind the focus, are traced once.
@ft.partial(jax.jit, static_argnames=("extent", "reach"))
def _arriving(
    extent: Extent,
    sheet: Sheets,
    first: Int[Array, ""],
    reach: int,
) -> Float[Array, "slice value height width"]:
    """Sums of the sprites of each slice of a group, per pixel of the frame.

    `sheet` is one of `_padded`.
    """
    across, dtype = across_of(reach), sheet.radius.dtype
    (turns, rows), columns = in_turns(2 * reach + 1, ROWS), 2 * across + 1
    above, beside = extent.reach - reach, across_of(extent.reach) - across
    values, high, wide = sheet.value.shape
    height = high - 2 * extent.reach - _below(extent)
    width = wide - 2 * across_of(extent.reach)
    edge = jnp.asarray(np.arange(columns)[None, None, :, None] - across + 0.5, dtype)

    def turn(index, sums):
        def near(x):
            part = jax.lax.dynamic_slice_in_dim(
                x[..., beside : beside + width + columns - 1],
                above + index * rows,
                height + rows - 1,
                axis=-2,
                allow_negative_indices=False,
            )
            return windows(part, -2, rows)

        there = lambda x: windows(near(x), -1, columns)
        # From the row that lies above the pixel: its sprites reach down.
        row = (reach - index * rows - jnp.arange(rows)).astype(dtype)
        span = jax.vmap(_half_width)(near(sheet.radius), row)
        moved = near(sheet.tilt[0]) * span * span / 3
        # Kept in memory: a reduction would compute it again for every tap.
        ends = jax.lax.optimization_barrier([moved - span, moved + span])
        ends = [windows(x, -1, columns) for x in ends]
        rows_and_tilt = row[:, None, None, None], there(sheet.tilt[1])
        light = [there(x) for x in shares], [there(x) for x in sheet.value]
        found = summed(term, (ends, edge, *rows_and_tilt, *light), (0, 2))
        return sums + jnp.stack(found).reshape(sums.shape)

    def term(ends, edge, row, tilt_y, shares, value):
        start, end = ends
        cover = clip01(end + edge) - clip01(start + edge)
        facing = 1 + tilt_y * row
        weights = [cover * (share * facing) for share in shares]
        return [weight * x for weight in weights for x in value]

    # Made here, or those of all groups would be made at once.
    shares, zero = share_of(_away(sheet, first)), jnp.zeros((), dtype)
    sheet, shares, zero = jax.lax.optimization_barrier((sheet, shares, zero))
    nothing = jnp.broadcast_to(zero, (GROUP, values, height, width))
    return fori_loop(0, turns, turn, nothing)


def _away(sheet: Sheets, first: Int[Array, ""]) -> Float[Array, "slice rows columns"]:
    """How many slices each sprite lies behind each slice of a group."""
    slices = first + jnp.arange(GROUP)
    return sheet.place[None] - slices.astype(sheet.place.dtype)[:, None, None]


def record(
    extent: Extent, sheets: Sheets
) -> tuple[Float[Array, "twice_value height width"], Record]:
    """The result of `forward`, and what `adjoint` needs of it."""

    def add(_sheet, number, first, arriving, _reach, state):
        for k, each in enumerate(arriving):
            state = fill(number * APART + first + k, each, state)
        return state

    return recorded(_each_group(extent, sheets, add, nothing_filled(extent, sheets)))


def forward(extent: Extent, sheets: Sheets) -> Float[Array, "twice_value height width"]:
    """Light and, last, how much of the lens it fills; then the same weighted."""

    def add(_sheet, _number, _first, arriving, _reach, state):
        for each in arriving:
            state = lit(each, *state)[:2]
        return state

    nothing = nothing_filled(extent, sheets).light
    state = nothing, nothing
    return jnp.concatenate(_each_group(extent, sheets, add, state))


def tangent(
    extent: Extent, sheets: Sheets, dot: Sheets
) -> Float[Array, "twice_value height width"]:
    """The derivative of `forward` along `dot`: its loops are short enough for JAX's own."""
    return jax.jvp(ft.partial(forward, extent), (sheets,), (dot,))[1]


def adjoint(
    extent: Extent,
    sheets: Sheets,
    bar: Float[Array, "twice_value height width"],
    record: Record,
) -> Sheets:
    """The transpose of `tangent`."""
    reading = begin_reading(record, bar)

    def read(sheet, number, first, arriving, reach, state):
        bars, carry = state
        seen = []
        for k, each in enumerate(arriving):
            bar, carry = read_slice(reading, number * APART + first + k, each, carry)
            seen.append(bar)
        found = _read_back(extent, sheet, first, reach, seen)
        bars = jax.tree.map(lambda x, y: x.at[number].add(y), bars, found)
        return bars, carry

    state = jax.tree.map(jnp.zeros_like, sheets), reading.start
    return _each_group(extent, sheets, read, state)[0]


@ft.partial(jax.jit, static_argnames=("extent", "reach"))
def _read_back(
    extent: Extent,
    sheet: Sheets,
    first: Int[Array, ""],
    reach: int,
    bars: list[Float[Array, "value height width"]],
) -> Sheets:
    """The adjoint of `_arriving` at `bars`, one for each slice of the group.

    It is one sum over the taps: a sprite weights what is seen of all slices by its shares.
    """
    far, across = extent.reach, across_of(reach)
    (turns, rows), taps = in_turns(2 * reach + 1, _ROWS_BACK), 2 * across + 1
    high, wide = sheet.radius.shape
    dtype = sheet.value.dtype
    below = far + turns * rows - reach - 1
    pad = [(0, 0), (far + reach, below), (far + across, far + across)]
    edge = jnp.asarray(across + 0.5 - np.arange(taps)[None, None, :, None], dtype)
    at_pixel = lambda x: x[None, :, None]
    of_sprite = lambda value, planes: ft.reduce(jnp.add, map(jnp.multiply, value, planes))
    # Kept in memory: a reduction would compute it again for every tap.
    operands = share_of(_away(sheet, first)), [jnp.pad(bar, pad) for bar in bars]
    shares, seen = jax.lax.optimization_barrier(operands)

    def turn(index, sums):
        row = (index * rows - reach + jnp.arange(rows)).astype(dtype)
        widths = jax.vmap(ft.partial(_half_width_and_slope, slope=True), (None, 0))
        span, slope = widths(sheet.radius, row)
        moved = sheet.tilt[:1] * span * span / 3
        row = row[:, None, None, None]

        def there(x):
            near = jax.lax.dynamic_slice_in_dim(
                x, index * rows, high + rows - 1, axis=-2, allow_negative_indices=False
            )
            return windows(windows(near, -2, rows), -1, taps)

        # Kept in memory: a reduction would compute it again for every tap.
        kept = jax.lax.optimization_barrier([moved - span, moved + span, slope])
        kept = [x[:, :, None] for x in kept]
        bars = [[there(x) for x in bar] for bar in seen]
        # Summed over slices: as they weight the sprite's light, and as the place does.
        mixed = [of_sprite(shares, planes) for planes in zip(*bars, strict=True)]
        moving = of_sprite(slopes, [of_sprite(value, bar) for bar in bars])
        inputs = kept, edge, row, tilt, value, mixed, moving
        return sums + jnp.stack(summed(term, inputs, (0, 2)))

    def term(kept, edge, row, tilt, value, mixed, moving):
        """The cotangents of value, place, tilt and radius."""
        start, end, slope = kept
        cover = clip01(end + edge) - clip01(start + edge)
        facing = 1 + tilt[1] * row
        light = of_sprite(value, mixed)
        # The tilt along x and the radius move the ends.
        at_end, at_start = inside(end + edge), inside(start + edge)
        # Both ends are moved by a third of the tilt times half their distance squared.
        distance = end - start
        moved = facing * (at_end - at_start) * distance
        grown = slope * (facing * (at_end + at_start) + moved * tilt[0] / 3)
        of_value = [facing * cover * x for x in mixed]
        of_tilt = moved * distance * light / 12, row * cover * light
        return of_value, facing * cover * moving, of_tilt, grown * light

    away = _away(sheet, first)
    slopes = share_slope_of(away)
    tilt, value, shares, slopes = (
        [at_pixel(x) for x in planes] for planes in (sheet.tilt, sheet.value, shares, slopes)
    )
    nothing = jnp.zeros((len(sheet.value) + 4, high, wide), dtype)
    *of_value, of_place, of_tilt_x, of_tilt_y, of_radius = fori_loop(0, turns, turn, nothing)
    found = Sheets(jnp.stack(of_value), of_radius, jnp.stack([of_tilt_x, of_tilt_y]), of_place)
    # As forward has it: what is not let through passes no derivative.
    return jax.tree.map(lambda x: jnp.where(sheet.value[-1] > 0, x, 0), found)


SHEET_ROWS = Program(
    together(forward),
    one_by_one(together(tangent)),
    together(adjoint),
    together(record),
)
