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
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from jaxfx._loops import fori_loop
from jaxfx._numerics import clip01
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
from jaxfx.dof.kernels._windows import AT_ONCE, in_turns, summed, together, windows
from jaxfx.dof.sprites import segment_integral


# Slices per group: their sums stay in registers. With more, the coverage of a tap is computed
# for fewer groups, but the sums take more memory.
GROUP = 3
# The most rows of offsets at a time. More are fewer launches, but where each sprite's span ends
# is kept for every one of them.
ROWS = 8


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


def _groups(extent: Extent, slices: int) -> list[tuple[int, int, int, int]]:
    """Runs of like groups from the front: first slice, groups, slices per group, and reach.

    Slices near the focus reach less far. A reach is the largest, or a half, a quarter of it and
    so on: each other one would be a program of its own to compile.
    """
    total = 2 * slices + 1
    count = -(-total // GROUP)
    bounds = [round(k * total / count) - slices for k in range(count + 1)]
    # Largest thickness of a slice, in pixels of radius.
    thick = extent.max_coc / 2 / max(slices - 1, 1)
    runs = []
    for low, high in itertools.pairwise(bounds):
        needed, reach = extent.reach_of(thick * (max(-low, high - 1) + 1)), extent.reach
        # Discs within their own pixel need a reach of 0, at which halving would never end.
        while reach > 1 and needed <= reach // 2:
            reach = reach // 2
        if runs and runs[-1][2:] == (high - low, reach):
            first, groups, *alike = runs.pop()
            runs.append((first, groups + 1, *alike))
        else:
            runs.append((low, 1, high - low, reach))
    return runs


def _each_group(
    extent: Extent,
    sheets: Sheets,
    visit: Callable[..., Any],
    state: Any,
    *,
    apart: bool = False,
) -> Any:
    """Fold `visit(sheet, number, first, arriving, reach, state)` over groups, from the front.

    `first` is the number of the group's first slice, `arriving` are the sums of each of them.
    With `apart` a kernel sums no more than two planes of one slice.
    """
    for number in range(len(sheets.radius)):
        sheet = jax.tree.map(lambda x, n=number: x[n], sheets)
        if extent.slices is None:
            first = jnp.floor(sheet.place.min()).astype(int)
            slices = jnp.ceil(sheet.place.max()).astype(int) - first + 1
            runs = [(first, -(-slices // GROUP), GROUP, extent.reach)]
        else:
            runs = _groups(extent, extent.slices)
        wide = _padded(extent, sheet)
        for start, groups, size, reach in runs:

            def add_group(k, state, run=(start, size, reach), wide=wide, n=number):
                start, size, reach = run
                first = start + k * size
                arriving = _arriving(extent, wide, first, size, reach, apart)
                return visit(_cropped(extent, wide), n, first, arriving, reach, state)

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


def _cropped(extent: Extent, wide: Sheets) -> Sheets:
    """The sheet of `_padded`."""
    beside = across_of(extent.reach) - extent.reach
    rows = wide.radius.shape[-2] - _below(extent)
    return jax.tree.map(lambda x: x[..., :rows, beside : x.shape[-1] - beside], wide)


def _below(extent: Extent) -> int:
    """The most rows of offsets that only fill up a turn."""
    return 2 * in_turns(2 * extent.reach + 1, ROWS)[0]


# Compiled: groups of one size and reach, before and behind the focus, are traced once.
@ft.partial(jax.jit, static_argnames=("extent", "count", "reach", "apart"))
def _arriving(
    extent: Extent,
    sheet: Sheets,
    first: Int[Array, ""],
    count: int,
    reach: int,
    apart: bool,
) -> Float[Array, "slice value height width"]:
    """Sums of the sprites of each slice of a group, per pixel of the frame.

    `sheet` is one of `_padded`, `apart` as `_each_group` has it.
    """
    slices, planes = (1, 2) if apart else (count, AT_ONCE)
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
        ends, added = (moved - span, moved + span), []
        for k in range(0, values, planes):
            of_slices = []
            for first_slice in range(0, count, slices):
                # Kept in memory; apart for each kernel, or all would share what covers a tap.
                ends = jax.lax.optimization_barrier(ends)
                start, end = (windows(x, -1, columns) for x in ends)
                cover = clip01(end + edge) - clip01(start + edge)
                facing = 1 + there(sheet.tilt[1]) * row[:, None, None, None]
                some = shares[first_slice : first_slice + slices]
                weights = [cover * (share * facing) for share in there(some)]
                light = there(sheet.value[k : k + planes])
                terms = [weight * x for weight in weights for x in light]
                of_slices += summed(terms, (0, 2))
            found = jnp.stack(of_slices)
            added.append(found.reshape(count, -1, height, width))
        return sums + jnp.concatenate(added, axis=1)

    # Made here, or those of all groups would be made at once.
    shares, zero = share_of(_away(sheet, first, count)), jnp.zeros((), dtype)
    sheet, shares, zero = jax.lax.optimization_barrier((sheet, shares, zero))
    nothing = jnp.broadcast_to(zero, (count, values, height, width))
    return fori_loop(0, turns, turn, nothing)


def _away(
    sheet: Sheets, first: Int[Array, ""], count: int
) -> Float[Array, "slice rows columns"]:
    """How many slices each sprite lies behind each slice of a group."""
    slices = first + jnp.arange(count)
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


def forward(
    extent: Extent, sheets: Sheets, *, apart: bool = False
) -> Float[Array, "twice_value height width"]:
    """Light and, last, how much of the lens it fills; then the same weighted."""

    def add(_sheet, _number, _first, arriving, _reach, state):
        for each in arriving:
            state = lit(each, *state)[:2]
        return state

    nothing = nothing_filled(extent, sheets).light
    state = nothing, nothing
    return jnp.concatenate(_each_group(extent, sheets, add, state, apart=apart))


def tangent(
    extent: Extent, sheets: Sheets, dot: Sheets
) -> Float[Array, "twice_value height width"]:
    """The derivative of `forward` along `dot`: its loops are short enough for JAX's own."""
    return jax.jvp(ft.partial(forward, extent, apart=True), (sheets,), (dot,))[1]


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
        found = _read_back(extent, sheet, first, reach, jnp.stack(seen))
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
    bar: Float[Array, "slice value height width"],
) -> Sheets:
    """The adjoint of `_arriving` at `bar`."""
    far, across = extent.reach, across_of(reach)
    (turns, rows), taps = in_turns(2 * reach + 1, ROWS), 2 * across + 1
    high, wide = sheet.radius.shape
    away = _away(sheet, first, len(bar))
    value, dtype = sheet.value, sheet.value.dtype
    sheet, shares, slopes = jax.lax.optimization_barrier(
        (sheet, share_of(away), share_slope_of(away))
    )
    below = far + turns * rows - reach - 1
    pad = [(0, 0), (0, 0), (far + reach, below), (far + across, far + across)]
    seen = jnp.pad(bar, pad)
    edge = jnp.asarray(across + 0.5 - np.arange(taps)[None, None, :, None], dtype)
    at_pixel = lambda x: x[None, :, None]

    def turn(index, sums):
        row = (index * rows - reach + jnp.arange(rows)).astype(dtype)
        widths = jax.vmap(ft.partial(_half_width_and_slope, slope=True), (None, 0))
        span, slope = widths(sheet.radius, row)
        moved = sheet.tilt[:1] * span * span / 3
        near = jax.lax.dynamic_slice_in_dim(
            seen, index * rows, high + rows - 1, axis=-2, allow_negative_indices=False
        )
        kept, added = (moved - span, moved + span, slope, near), []
        row = row[:, None, None, None]

        def terms_of(kind, kept, sheet, shares, slopes):
            start, end, slope = (x[:, :, None] for x in kept[:3])
            there = windows(windows(kept[3], -2, rows), -1, taps)
            end_in, start_in = end + edge, start + edge
            cover = clip01(end_in) - clip01(start_in)
            tilt_x, facing = at_pixel(sheet.tilt[0]), 1 + at_pixel(sheet.tilt[1]) * row

            def over_slices(weights, k):
                return sum(at_pixel(w) * x[k] for w, x in zip(weights, there, strict=True))

            def of_sprite(weights):
                values = enumerate(sheet.value)
                return sum(at_pixel(x) * over_slices(weights, k) for k, x in values)

            if kind == "value":
                ks = range(len(value))
                return [facing * cover * over_slices(shares, k) for k in ks]
            if kind == "tilt_y, place":
                return [row * cover * of_sprite(shares), facing * cover * of_sprite(slopes)]
            # Where an end lies: no other pixel changes with it.
            span, worth = (end - start) / 2, facing * of_sprite(shares)
            moved = worth * (inside(end_in) - inside(start_in))
            grown = worth * (inside(end_in) + inside(start_in))
            of_radius = slope * (grown + moved * tilt_x * span * (2 / 3))
            return [moved * span * span / 3, of_radius]

        groups = [("value", k) for k in range(0, len(value), AT_ONCE)]
        for kind, k in [*groups, ("tilt_y, place", 0), ("tilt_x, radius", 0)]:
            # Kept in memory; and apart for each kernel, or all would share what covers a tap.
            kept, *own = jax.lax.optimization_barrier((kept, sheet, shares, slopes))
            terms = terms_of(kind, kept, *own)
            added += summed(terms[k : k + AT_ONCE], (0, 2))
        return sums + jnp.stack(added)

    nothing = jnp.zeros((len(value) + 4, high, wide), dtype)
    sums = fori_loop(0, turns, turn, nothing)
    *of_value, of_tilt_y, of_place, of_tilt_x, of_radius = sums
    tilt = jnp.stack([of_tilt_x, of_tilt_y])
    found = Sheets(jnp.stack(of_value), of_radius, tilt, of_place)
    # As forward has it: what is not let through passes no derivative.
    return jax.tree.map(lambda x: jnp.where(value[-1] > 0, x, 0), found)


SHEET_ROWS = Program(*map(together, (forward, tangent, adjoint, record)))
