"""Rays on a grid of texels: when a ray crosses which border, without rounding at corners.

Texel (j, i) covers [i, i + 1) x [j, j + 1). Hence a ray that runs towards larger x is in the
next column at the moment it crosses the border, one that runs towards smaller x only after it.
A crossing is therefore a time and whether it lies just `after` that time.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Rays(eqx.Module):
    """Origins, directions and their reciprocals by coordinate; no border's time is NaN.

    They begin at time 0. With `from_end`, those that run away from the viewer begin at -1 and
    come to their origin at 0: of a time near 0 more digits are kept, and in 1 / z all that is
    far away lies close to the end.
    """

    ox: Float[Array, " ray"]
    oy: Float[Array, " ray"]
    oz: Float[Array, " ray"]
    dx: Float[Array, " ray"]
    dy: Float[Array, " ray"]
    dz: Float[Array, " ray"]
    ix: Float[Array, " ray"]
    iy: Float[Array, " ray"]
    iz: Float[Array, " ray"]
    from_end: bool = eqx.field(static=True)


class Moment(NamedTuple):
    """A time, or just after it."""

    time: Float[Array, "..."]
    after: Bool[Array, "..."]


def rays(
    origin: Float[Array, "ray 3"], direction: Float[Array, "ray 3"], from_end: bool = False
) -> Rays:
    """The rays, those parallel to an axis moved to the middle of their row or column."""
    dx, dy, dz = (jnp.where(d == 0, 0, d) for d in jnp.moveaxis(direction, -1, 0))
    ox, oy, oz = jnp.moveaxis(origin, -1, 0)
    ox = jnp.where(dx == 0, jnp.floor(ox) + 0.5, ox)
    oy = jnp.where(dy == 0, jnp.floor(oy) + 0.5, oy)
    return Rays(ox, oy, oz, dx, dy, dz, 1 / dx, 1 / dy, 1 / dz, from_end)


def crossing(border: Array, o: Array, i: Array, backward: Array) -> Moment:
    """When a ray crosses a border of its axis: never, +inf or -inf, where it is parallel.

    `backward` is 1 where it runs towards smaller coordinates, else 0.
    """
    return Moment((border.astype(o.dtype) - o) * i, backward == 1)


def came(r: Rays, x: Array, y: Array, left: Array, up: Array) -> tuple[Moment, Moment]:
    """When a ray came into a column and into a row, were it without beginning."""
    return crossing(x + left, r.ox, r.ix, left), crossing(y + up, r.oy, r.iy, up)


def entered(r: Rays, came_x: Moment, came_y: Moment) -> Moment:
    """When a ray is first in both a column and a row."""
    last = latest(came_x, came_y)
    time = since_start(last.time, r.iz, r.from_end)
    return Moment(time, last.after & (last.time == time))


def start(dz: Float[Array, "..."], from_end: bool) -> Float[Array, "..."]:
    """The time at which rays begin."""
    return since_start(jnp.full_like(dz, -jnp.inf), dz, from_end)


def since_start(
    time: Float[Array, "..."], dz: Float[Array, "..."], from_end: bool
) -> Float[Array, "..."]:
    """A time or, if it is earlier, that at which the ray begins; of `dz` the sign counts.

    Of each the later is taken before one is chosen: XLA would carry the times at which rays
    begin through the walk's loop, an array more to read in each step.
    """
    later = jnp.maximum(time, 0)
    return jnp.where(dz > 0, jnp.maximum(time, -1), later) if from_end else later


def earlier(one: Moment, other: Moment) -> Bool[Array, "..."]:
    """Whether `one` comes strictly before `other`."""
    return (one.time < other.time) | ((one.time == other.time) & ~one.after & other.after)


def latest(one: Moment, other: Moment) -> Moment:
    """The later of two moments."""
    after = jnp.where(one.time < other.time, other.after, one.after)
    after = jnp.where(one.time == other.time, one.after | other.after, after)
    return Moment(jnp.maximum(one.time, other.time), after)


def first(one: Moment, other: Moment) -> Moment:
    """The sooner of two moments."""
    after = jnp.where(one.time < other.time, one.after, other.after)
    after = jnp.where(one.time == other.time, one.after & other.after, after)
    return Moment(jnp.minimum(one.time, other.time), after)


def cell_at(moment: Moment, o: Array, d: Array, backward: Array) -> Int[Array, "..."]:
    """The row or column in which a ray is at a moment."""
    place = o + moment.time * d
    crossed = moment.after & (backward == 1)
    return jnp.where(crossed, jnp.ceil(place) - 1, jnp.floor(place)).astype(jnp.int32)


def backward(r: Rays) -> tuple[Int[Array, " ray"], Int[Array, " ray"]]:
    """1 where a ray runs to the left, and upwards; else 0."""
    return (r.dx < 0).astype(jnp.int32), (r.dy < 0).astype(jnp.int32)


class Entry(NamedTuple):
    """The texel in which a ray first is inside the image, and whether it ever is."""

    x: Int[Array, " ray"]
    y: Int[Array, " ray"]
    inside: Bool[Array, " ray"]


def entry(r: Rays, height: int, width: int) -> Entry:
    """Where a ray comes into the image, when it begins at the earliest."""
    left, up = backward(r)
    edge_x, edge_y = left * (width - 1), up * (height - 1)
    enter_x, enter_y = came(r, edge_x, edge_y, left, up)
    when = entered(r, enter_x, enter_y)
    x = _beyond(edge_x, left, cell_at(when, r.ox, r.dx, left), earlier(enter_x, when))
    y = _beyond(edge_y, up, cell_at(when, r.oy, r.dy, up), earlier(enter_y, when))
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    known = jnp.isfinite(r.ox + r.oy + r.oz) & jnp.isfinite(r.dx + r.dy + r.dz)
    return Entry(x, y, inside & known)


def _beyond(edge: Array, backward: Array, cell: Array, has_passed: Array) -> Array:
    """The row or column at the edge of the image or, past it, one inside, whatever rounding."""
    inner = jnp.where(backward == 1, jnp.minimum(cell, edge), jnp.maximum(cell, edge))
    return jnp.where(has_passed, inner, edge)
