"""Rays on a grid of texels: when a ray crosses which border, without rounding at corners.

Texel (j, i) covers [i, i + 1) x [j, j + 1). Hence a ray that runs towards larger x is in the
next column at the moment it crosses the border, one that runs towards smaller x only after it.
A crossing is therefore a time and whether it lies just `after` that time.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Rays(NamedTuple):
    """Origins, directions and their reciprocals by coordinate; no border's time is NaN."""

    ox: Float[Array, " ray"]
    oy: Float[Array, " ray"]
    oz: Float[Array, " ray"]
    dx: Float[Array, " ray"]
    dy: Float[Array, " ray"]
    dz: Float[Array, " ray"]
    ix: Float[Array, " ray"]
    iy: Float[Array, " ray"]
    iz: Float[Array, " ray"]


class Moment(NamedTuple):
    """A time, or just after it."""

    time: Float[Array, "..."]
    after: Bool[Array, "..."]


def rays(origin: Float[Array, "ray 3"], direction: Float[Array, "ray 3"]) -> Rays:
    """The rays, those parallel to an axis moved to the middle of their row or column."""
    dx, dy, dz = (jnp.where(d == 0, 0, d) for d in jnp.moveaxis(direction, -1, 0))
    ox, oy, oz = jnp.moveaxis(origin, -1, 0)
    ox = jnp.where(dx == 0, jnp.floor(ox) + 0.5, ox)
    oy = jnp.where(dy == 0, jnp.floor(oy) + 0.5, oy)
    return Rays(ox, oy, oz, dx, dy, dz, 1 / dx, 1 / dy, 1 / dz)


def crossing(border: Array, o: Array, i: Array, backward: Array) -> Moment:
    """When a ray crosses a border of its axis: never, +inf or -inf, where it is parallel.

    `backward` is 1 where it runs towards smaller coordinates, else 0.
    """
    return Moment((border.astype(o.dtype) - o) * i, backward == 1)


def came(r: Rays, x: Array, y: Array, left: Array, up: Array) -> tuple[Moment, Moment]:
    """When a ray came into a column and into a row."""
    return crossing(x + left, r.ox, r.ix, left), crossing(y + up, r.oy, r.iy, up)


def start(r: Rays) -> Moment:
    """Time 0."""
    return Moment(jnp.zeros_like(r.ox), jnp.zeros(r.ox.shape, bool))


def earlier(one: Moment, other: Moment) -> Bool[Array, "..."]:
    """Whether `one` comes strictly before `other`."""
    return (one.time < other.time) | ((one.time == other.time) & ~one.after & other.after)


def latest(moment: Moment, *others: Moment) -> Moment:
    """The last of several moments."""
    for other in others:
        after = (moment.after | other.after) & (moment.time == other.time)
        after = after | jnp.where(moment.time < other.time, other.after, moment.after)
        moment = Moment(jnp.maximum(moment.time, other.time), after)
    return moment


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
    """Where a ray comes into the image, at time 0 at the earliest."""
    left, up = backward(r)
    edge_x, edge_y = left * (width - 1), up * (height - 1)
    enter_x, enter_y = came(r, edge_x, edge_y, left, up)
    when = latest(start(r), enter_x, enter_y)
    x = jnp.where(earlier(enter_x, when), cell_at(when, r.ox, r.dx, left), edge_x)
    y = jnp.where(earlier(enter_y, when), cell_at(when, r.oy, r.dy, up), edge_y)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    known = jnp.isfinite(r.ox + r.oy + r.oz) & jnp.isfinite(r.dx + r.dy + r.dz)
    return Entry(x, y, inside & known)
