"""The lens of each pixel, filled by slices from the front; and the adjoint of that.

A slice sums, at a pixel, to light and to the share of the lens that it covers. Each slice takes
the room that is left; behind the slice that fills the lens none is. The part of a lens that
stays free has the mean colour of what arrived (the fallback colour), in which a contribution
counts for more the more was filled before it.

The adjoint keeps no slice. Per pixel it knows the slice that filled the lens, the part of that
slice that found room, and its colour. Slices in front count in full and, by the room that they
take, against that colour.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._numerics import sum_planes
from jaxfx.dof.kernels._slices import Extent, Sheets


# Number of a slice behind all others: the lens is not filled yet.
_NEVER = 2**30
# Units of rounding (machine epsilons): an aperture covered to within this many counts as full.
# Without them a sum of shares that rounds to just below 1 would let a sliver through.
_ROUNDING = 32
# Weight of a contribution in the fallback colour where nothing has been accumulated; it rises
# linearly by 1 to where the aperture is covered. With 0 a pixel that
# only its first slice reaches has no fallback colour; larger, and the foreground bleeds.
_FIRST = 0.1

Stack = Float[Array, "value height width"]
Plane = Float[Array, "height width"]


class Filling(NamedTuple):
    """Accumulator of front-to-back compositing, per pixel.

    - `light`: the channels and, last, the share of the lens that is filled.
    - `late`: the same, each contribution weighted as it counts in the fallback colour.
    - `last`: the number of the slice that filled the lens; `arrived`: what that one summed to;
      `part`: the part of it that found room.
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


def fill(index: Int[Array, ""], arriving: Stack, state: Filling) -> Filling:
    """The accumulator after one more slice."""
    allowed, weight, full = allowance(arriving, state.light)
    fills = full & (state.last == _NEVER)  # once
    found = allowed[None] * arriving
    return Filling(
        state.light + found,
        state.late + weight[None] * found,
        jnp.where(fills, index, state.last),
        jnp.where(fills[None], arriving, state.arrived),
        jnp.where(fills, allowed, state.part),
    )


def allowance(
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


class Reading(NamedTuple):
    """Values per pixel that the adjoint reads at every slice.

    `bar` and `late_bar` are the cotangents of light and of the weighted light; `worth` is what
    the slice that filled the lens would give for a unit of it, and `weight` that slice's in the
    fallback colour. `start` is the carry of `read_slice`.
    """

    filling: Filling
    bar: Stack
    late_bar: Stack
    weight: Plane
    worth: Plane
    start: tuple[Plane, Plane]


def begin_reading(filling: Filling, bar: Float[Array, "twice_value height width"]) -> Reading:
    """The pixels before the adjoint comes to the first slice."""
    bar, late_bar = jnp.split(bar, 2)
    # The slice that fills a lens gives it as much of its colour as there is room.
    arrived, part = filling.arrived, filling.part
    color = arrived / jnp.where(part > 0, arrived[-1], 1)[None]
    room = part * arrived[-1]
    weight = filling.light[-1] - room / 2 + _FIRST
    late_worth = sum_planes(late_bar * color)
    worth = sum_planes(bar * color) + weight * late_worth
    # What takes room takes it from that, and makes all that comes later count for more.
    ahead = sum_planes(late_bar * filling.light) - room * late_worth / 2
    return Reading(filling, bar, late_bar, weight, worth, (jnp.zeros_like(part), ahead))


def read_slice(
    reading: Reading, index: Int[Array, ""], arriving: Stack, state: tuple[Plane, Plane]
) -> tuple[Stack, tuple[Plane, Plane]]:
    """The cotangent of a slice's sums, from the front; and the carry for the next one."""
    filled, ahead = state
    filling, bar, late_bar, weight_last, worth, _ = reading
    before, last = index < filling.last, index == filling.last
    late = sum_planes(late_bar * arriving)
    weight = jnp.where(before, filled + arriving[-1] / 2 + _FIRST, weight_last)
    seen = bar + weight[None] * late_bar
    seen = seen.at[-1].add(jnp.where(before, ahead - late / 2, 0) - worth)
    counted = jnp.where(before, 1, jnp.where(last, filling.part, 0))
    took = lambda x: jnp.where(before, x, 0)
    return counted[None] * seen, (filled + took(arriving[-1]), ahead - took(late))
