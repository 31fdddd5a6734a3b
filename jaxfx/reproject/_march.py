"""The three searches that may err: the source's descent, parallax occlusion, relief mapping."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._pyramid import Pyramid, minimum_pyramid
from jaxfx.reproject import _grid
from jaxfx.reproject._found import START, TOP, Found
from jaxfx.reproject._grid import Entry, Rays


# Equal steps where the caller does not say; halvings of the last one.
_STEPS, _HALVINGS = 64, 8


def descend(
    depth: Float[Array, "height width"],
    origin: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
    max_steps: int | None,
    from_end: bool,
) -> Found:
    """From the pyramid's root to a leaf, on to a node's depth where the ray is nearer.

    No border is looked at: a node that the ray has left on its way may have held the hit.
    """
    r, begin = _entering(depth, origin, direction, from_end)
    pyramid = minimum_pyramid(depth)
    time, _ = _interval(depth, r, begin)
    levels = len(pyramid.shapes) if max_steps is None else min(len(pyramid.shapes), max_steps)
    nearest = jnp.full_like(time, jnp.inf)
    for level in reversed(range(len(pyramid.shapes) - levels, len(pyramid.shapes))):
        nearest = _read(pyramid, level, *_place(r, time))
        reach = (nearest - r.oz) * r.iz
        time = jnp.where((r.dz > 0) & (reach > time) & (nearest < jnp.inf), reach, time)
    x, y = _place(r, time)
    inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
    meets = jnp.where(r.dz > 0, nearest < jnp.inf, r.oz + time * r.dz >= nearest)
    steps = jnp.where(begin.inside, levels, 0)
    mask = begin.inside & inside & meets
    complete = levels == len(pyramid.shapes)
    return _found(depth, r, time, x, y, mask & complete, steps)._replace(
        exhausted=begin.inside & (not complete)
    )


def linear(
    depth: Float[Array, "height width"],
    origin: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
    max_steps: int | None,
    from_end: bool,
) -> Found:
    """Equal steps until the ray is behind the depth, then one secant."""
    r, begin = _entering(depth, origin, direction, from_end)
    before, after, found, steps = _first_behind(depth, r, begin, max_steps)
    gap_before, gap_after = (_gap(depth, r, time) for time in (before, after))
    known = found & jnp.isfinite(gap_before) & (gap_before < 0)
    slope = jnp.where(known, gap_after - gap_before, 1)
    share = jnp.where(known, -gap_before / slope, 1)
    time = before + share * (after - before)
    return _found(depth, r, time, *_place(r, time), found, steps)


def relief(
    depth: Float[Array, "height width"],
    origin: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
    max_steps: int | None,
    from_end: bool,
) -> Found:
    """Equal steps until the ray is behind the depth, then bisection of the last."""
    r, begin = _entering(depth, origin, direction, from_end)
    before, after, found, steps = _first_behind(depth, r, begin, max_steps)

    def halve(_, ends):
        before, after = ends
        middle = (before + after) / 2
        behind = _gap(depth, r, middle) >= 0
        return jnp.where(behind, before, middle), jnp.where(behind, middle, after)

    _, time = jax.lax.fori_loop(0, _HALVINGS, halve, (before, after))
    steps = steps + jnp.where(found, _HALVINGS, 0)
    return _found(depth, r, time, *_place(r, time), found, steps)


def _entering(
    depth: Array, origin: Array, direction: Array, from_end: bool
) -> tuple[Rays, Entry]:
    r = _grid.rays(origin, direction, from_end)
    return r, _grid.entry(r, *depth.shape)


def _first_behind(depth: Array, r: Rays, begin: Entry, max_steps: int | None):
    """The two times between which a ray is first seen to go behind the depth."""
    count = _STEPS if max_steps is None else max_steps
    start, end = _interval(depth, r, begin)
    length = (end - start) / count

    def look(index, first):
        gap = _gap(depth, r, start + index.astype(start.dtype) * length)
        return jnp.where((gap >= 0) & (first > count), index.astype(jnp.int32), first)

    first = jnp.where(begin.inside, count + 1, 0).astype(jnp.int32)
    first = jax.lax.fori_loop(0, count + 1, look, first)
    found = begin.inside & (first <= count)
    after = start + first.astype(start.dtype) * length
    before = jnp.where(first == 0, after, after - length)
    steps = jnp.where(begin.inside, jnp.minimum(first, count) + 1, 0)
    before, after = (jnp.where(found, time, start) for time in (before, after))
    return before, after, found, steps.astype(jnp.int32)


def _interval(depth: Array, r: Rays, begin: Entry) -> tuple[Array, Array]:
    """From where a ray enters the image to where it leaves it or is behind all there is."""
    height, width = depth.shape
    left, up = _grid.backward(r)
    x, y = (jnp.where(begin.inside, cell, 0) for cell in (begin.x, begin.y))
    start = _grid.entered(r, *_grid.came(r, x, y, left, up)).time
    leave_x = _grid.crossing((1 - left) * width, r.ox, r.ix, left).time
    leave_y = _grid.crossing((1 - up) * height, r.oy, r.iy, up).time
    farthest = jnp.max(jnp.where(depth < jnp.inf, depth, -jnp.inf))
    # With room for rounding: the last step is to be behind the farthest texel as well.
    terms = jnp.abs(farthest) + jnp.abs(r.oz) + jnp.abs(start * r.dz)
    slack = 8 * jnp.finfo(depth.dtype).eps * terms
    behind = (farthest + slack - r.oz) * r.iz
    behind = jnp.where((r.dz > 0) & (farthest > -jnp.inf), behind, jnp.inf)
    end = jnp.minimum(jnp.minimum(leave_x, leave_y), behind)
    start = jnp.where(begin.inside, start, 0)
    return start, jnp.where(end < jnp.inf, jnp.maximum(end, start), start)


def _place(r: Rays, time: Array) -> tuple[Int[Array, " ray"], Int[Array, " ray"]]:
    """The column and the row at a time."""
    cells = jnp.floor(r.ox + time * r.dx), jnp.floor(r.oy + time * r.dy)
    x, y = (jnp.clip(cell, -1, 2**30).astype(jnp.int32) for cell in cells)
    return x, y


def _read(pyramid: Pyramid, level: int, x: Array, y: Array) -> Float[Array, " ray"]:
    """The texel of a level above that of the depth, the image's own beyond it."""
    height, width = pyramid.shapes[level]
    column = jnp.clip(x >> level, 0, width - 1)
    row = jnp.clip(y >> level, 0, height - 1)
    return pyramid.values[pyramid.offsets[level] + row * width + column]


def _gap(depth: Array, r: Rays, time: Array) -> Float[Array, " ray"]:
    """How far behind the depth a ray is."""
    x, y = _place(r, time)
    texel = depth[jnp.clip(y, 0, depth.shape[0] - 1), jnp.clip(x, 0, depth.shape[1] - 1)]
    return r.oz + time * r.dz - texel


def _found(depth, r, time, x, y, mask, steps) -> Found:
    x, y = jnp.clip(x, 0, depth.shape[1] - 1), jnp.clip(y, 0, depth.shape[0] - 1)
    side = jnp.where(time > _grid.start(r.dz, r.from_end), TOP, START)
    return Found(time, x, y, side, mask, steps.astype(jnp.int32), jnp.zeros_like(mask))
