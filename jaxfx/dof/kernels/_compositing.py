"""Compositing the slices at each pixel from front to back, and the adjoint of that.

At a pixel, a slice has some light and the share of the pixel's lens that it covers. Each slice
takes as much of the lens as is left; what lies behind a full lens is hidden. The share that no
slice takes gets the fallback colour: a mean of the slices, each weighted by how full the lens
was when it was added.

The adjoint does not store the slices. Per pixel a record holds the number of the slice that
filled the lens, its colour, and the fraction of it that found room. A slice in front of that
one is added in full, and the room that it takes is lost to the slice that fills the lens.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._xla import sum_planes
from jaxfx.dof.kernels._slices import Extent, Sheets


# Stands for the number of the slice that filled the lens where no slice has filled it. Larger
# than any number of a slice.
_NEVER = 2**30
# Machine epsilons. A lens that is filled up to this many counts as full.
# Without them a sum of shares that rounds to just below 1 would let a sliver through.
_ROUNDING = 32
# Weight of a contribution to the fallback colour where the lens is still empty; it rises
# linearly, to 1 more where the lens is full. With 0, what reaches a lens that is nearly empty
# has a weight near 0; with more, the colour of the foreground bleeds into the background.
_FIRST = 0.1

Stack = Float[Array, "value height width"]
Plane = Float[Array, "height width"]


class Filling(NamedTuple):
    """Accumulator of front-to-back compositing, per pixel.

    - `light`: the channels and, last, the share of the lens that is filled.
    - `late`: the same, each contribution times its weight in the fallback colour.
    - `last`: the number of the slice that filled the lens, or `_NEVER`.
    - `arrived`: the light and share of that slice, before it is reduced to the room left.
    - `part`: the fraction of that slice that found room.
    """

    light: Stack
    late: Stack
    last: Int[Array, "height width"]
    arrived: Stack
    part: Plane


def nothing_filled(extent: Extent, sheets: Sheets) -> Filling:
    """The accumulator of empty lenses, in all pixels of the frame."""
    _, values, *padded = sheets.value.shape
    shape = tuple(n - 2 * extent.reach for n in padded)
    zero = jnp.zeros(shape, sheets.value.dtype)
    nothing = jnp.zeros((values, *shape), zero.dtype)
    return Filling(nothing, nothing, jnp.full(shape, _NEVER), nothing, zero)


class Record(NamedTuple):
    """Intermediate images of a compositing, kept for its adjoint.

    - `sums`: `light` and `late`, concatenated.
    - `last`, `arrived`, `part`: those of `Filling`, the first as a float.
    """

    sums: Float[Array, "twice_value height width"]
    last: Plane
    arrived: Stack
    part: Plane


def recorded(filling: Filling) -> tuple[Float[Array, "twice_value height width"], Record]:
    """The sums, and the record of them."""
    sums = jnp.concatenate([filling.light, filling.late])
    # A float counts slices exactly, and `_NEVER` is a power of two.
    last = filling.last.astype(sums.dtype)
    return sums, Record(sums, last, filling.arrived, filling.part)


def fill(index: Int[Array, ""], arriving: Stack, state: Filling) -> Filling:
    """The accumulator after one more slice."""
    light, late, allowed, full = lit(arriving, state.light, state.late)
    fills = full & (state.last == _NEVER)  # Slices behind that one do not find room either.
    return Filling(
        light,
        late,
        jnp.where(fills, index, state.last),
        jnp.where(fills[None], arriving, state.arrived),
        jnp.where(fills, allowed, state.part),
    )


def lit(
    arriving: Stack, light: Stack, late: Stack
) -> tuple[Stack, Stack, Plane, Bool[Array, "height width"]]:
    """`light` and `late` after one more slice; what found room of it, and where not all did."""
    allowed, weight, full = allowance(arriving, light)
    added = allowed[None] * arriving
    return light + added, late + weight[None] * added, allowed, full


def allowance(
    arriving: Float[Array, "value height width"], light: Float[Array, "value height width"]
) -> tuple[Float[Array, "height width"], Float[Array, "height width"], Bool[Array, "*size"]]:
    """How much of a slice finds room in a lens that is filled by `light`.

    Three planes: the fraction that finds room; the slice's weight in the fallback colour, which
    is the share filled when half of it has been added, plus `_FIRST`; and whether some of it
    finds no room.
    """
    filled, share = light[-1], arriving[-1]
    # Rounding must not make the room negative.
    room = 1 - _ROUNDING * jnp.finfo(light.dtype).eps - filled
    room = jnp.where(room > 0, room, 0)
    full = share > room
    allowed = jnp.where(full, room / jnp.where(full, share, 1), 1)
    return allowed, filled + allowed * share / 2 + _FIRST, full


class Reading(NamedTuple):
    """Values per pixel that the adjoint reads at every slice.

    - `last`, `part`: those of `Filling`.
    - `bar`, `late_bar`: the cotangents of `light` and of `late`.
    - `weight`: that of the slice that filled the lens, in the fallback colour.
    - `worth`: the derivative of the loss with respect to the share of the lens that this slice
      gets.
    - `start`: the carry of `read_slice` for the first slice.
    """

    last: Int[Array, "height width"]
    part: Plane
    bar: Stack
    late_bar: Stack
    weight: Plane
    worth: Plane
    start: tuple[Plane, Plane]


def begin_reading(record: Record, bar: Float[Array, "twice_value height width"]) -> Reading:
    """Operands of `read_slice`; `bar` is the cotangent of the sums."""
    bar, late_bar = jnp.split(bar, 2)
    light, _ = jnp.split(record.sums, 2)
    # The slice that fills a lens adds its mean colour times the room that was left.
    arrived, part = record.arrived, record.part
    color = arrived / jnp.where(part > 0, arrived[-1], 1)[None]
    room = part * arrived[-1]
    weight = light[-1] - room / 2 + _FIRST
    late_worth = sum_planes(late_bar * color)
    worth = sum_planes(bar * color) + weight * late_worth
    # A slice in front leaves less room to that one, and increases the weights in the fallback
    # colour of all slices behind. `ahead` is the derivative of the loss through those weights.
    ahead = sum_planes(late_bar * light) - room * late_worth / 2
    start = jnp.zeros_like(part), ahead
    return Reading(record.last.astype(int), part, bar, late_bar, weight, worth, start)


def read_slice(
    reading: Reading, index: Int[Array, ""], arriving: Stack, state: tuple[Plane, Plane]
) -> tuple[Stack, tuple[Plane, Plane]]:
    """The cotangent of a slice's sums, from the front; and the carry for the next one.

    The carry: the share of the lens that is filled, and the derivative of the loss through the
    fallback weights of all slices behind.
    """
    filled, ahead = state
    last, part, bar, late_bar, weight_last, worth, _ = reading
    before, is_last = index < last, index == last
    late = sum_planes(late_bar * arriving)
    weight = jnp.where(before, filled + arriving[-1] / 2 + _FIRST, weight_last)
    added_bar = bar + weight[None] * late_bar
    added_bar = added_bar.at[-1].add(jnp.where(before, ahead - late / 2, 0) - worth)
    allowed = jnp.where(before, 1, jnp.where(is_last, part, 0))
    if_before = lambda x: jnp.where(before, x, 0)
    carry = filled + if_before(arriving[-1]), ahead - if_before(late)
    return allowed[None] * added_bar, carry
