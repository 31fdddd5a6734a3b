"""From the texel that a search found to the point on the surface, with its derivative.

At the hit, F(t) = z(t) - D(x(t), y(t)) = 0, hence dt = -dF / F_t: the time is what was found,
less the differentiable F over a held F_t. No loop is differentiated.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx.reproject import _grid
from jaxfx.reproject._found import TOP, X_SIDE, Y_SIDE, Found
from jaxfx.reproject._patch import patch


# Newton steps on the patch; how far from the texel's hit they may lead, in texels; how long
# the last may be; below which share of its terms F_t counts as grazing.
_NEWTON, _REACH, _ARRIVED, _GRAZING = 4, 1.5, 1e-2, 1e-3


class Point(NamedTuple):
    """Where on its line each ray meets the surface; whether that is too slanting to tell."""

    position: Float[Array, "ray 3"]
    grazing: Bool[Array, " ray"]


def texel_point(depth: Array, origin: Array, direction: Array, found: Found) -> Point:
    """The hit on the top or on a side of a texel."""
    miss, slope = _texel_miss(depth, origin, direction, found)
    grazing = (slope == 0) & found.mask
    known = found.mask & ~grazing
    return _differentiable(origin, direction, found.time, miss, slope, known, grazing)


def _texel_miss(
    depth: Array, origin: Array, direction: Array, found: Found
) -> tuple[Float[Array, " ray"], Float[Array, " ray"]]:
    """What is 0 at the hit of a top or a side, and how fast it grows along the ray."""
    x, y, z = jnp.moveaxis(origin + found.time[:, None] * direction, -1, 0)
    dx, dy, dz = jnp.moveaxis(jax.lax.stop_gradient(direction), -1, 0)
    top = jnp.where(found.mask, depth[found.y, found.x], 0)
    held = [jnp.zeros_like(x)] * 4
    miss, slope = list(held), [jnp.ones_like(x)] * 4
    miss[TOP], slope[TOP] = z - jnp.where(jnp.isfinite(top), top, 0), dz
    miss[X_SIDE], slope[X_SIDE] = x, dx
    miss[Y_SIDE], slope[Y_SIDE] = y, dy
    return (
        jnp.choose(found.side, miss, mode="clip"),
        jnp.choose(found.side, slope, mode="clip"),
    )


def bilinear_point(
    depth: Array,
    origin: Array,
    direction: Array,
    found: Found,
    threshold: int | float | None,
    *,
    from_end: bool = False,
) -> Point:
    """The hit on the patch through the texels' centres, near the one that was found.

    Where the ray does not meet the patch within a texel or so, the texel's own hit stays, and
    its derivative.
    """
    hold = jax.lax.stop_gradient
    depth_held, o, d = hold(depth), hold(origin), hold(direction)
    anchor = jnp.where(found.mask, depth_held[found.y, found.x], 0)

    def gap(depth, origin, direction, time):
        x, y, z = jnp.moveaxis(origin + time[:, None] * direction, -1, 0)
        return z - patch(depth_held, x, y, anchor, threshold).read(depth)

    along = lambda time: jax.jvp(
        lambda t: gap(depth_held, o, d, t), (time,), (jnp.ones_like(time),)
    )
    per_texel = jnp.maximum(jnp.abs(d[:, 0]), jnp.abs(d[:, 1]))
    reach = jnp.where(per_texel > 0, _REACH / jnp.where(per_texel > 0, per_texel, 1), jnp.inf)
    low = _grid.since_start(found.time - reach, d[:, 2], from_end)
    high = found.time + reach

    def newton(step, state):
        time, last, _ = state
        value, slope = along(time)
        move = -value / jnp.where(slope > 0, slope, 1)
        moves = (slope > 0) & (step < _NEWTON)
        last = jnp.where(moves, jnp.abs(move), jnp.where(step < _NEWTON, jnp.inf, last))
        return jnp.where(moves, jnp.clip(time + move, low, high), time), last, slope

    # Once more for the slope: what the loop gives is in memory, and no reader computes it anew.
    start = found.time, jnp.full_like(found.time, jnp.inf), jnp.ones_like(found.time)
    time, last, slope = jax.lax.fori_loop(0, _NEWTON + 1, newton, start)
    terms = jnp.abs(d[:, 2]) + jnp.abs(slope - d[:, 2])
    steep = slope > _GRAZING * terms
    arrived = steep & (last * per_texel < _ARRIVED) & found.mask
    time = jnp.where(arrived, time, found.time)
    texel_miss, texel_slope = _texel_miss(depth, origin, direction, found)
    miss = jnp.where(arrived, gap(depth, origin, direction, time), texel_miss)
    slope = jnp.where(arrived, slope, texel_slope)
    known, grazing = found.mask & (slope != 0), found.mask & ~arrived
    return _differentiable(origin, direction, time, miss, slope, known, grazing)


def _differentiable(origin, direction, time, miss, slope, known, grazing) -> Point:
    """The position at a held time that follows the arguments, where `known`."""
    time = _at_zero(time, jnp.where(known, miss, 0), jnp.where(known, slope, 1))
    return Point(origin + time[:, None] * direction, grazing)


@jax.custom_jvp
def _at_zero(time: Array, miss: Array, slope: Array) -> Array:
    """The time at which `miss` is 0, that it grows from by `slope`. No miss is computed."""
    return time


@_at_zero.defjvp
def _at_zero_jvp(primals, tangents):
    time, _, slope = primals
    return time, -tangents[1] / slope
