"""The exact traversal of a minimum pyramid, many rays in step.

The state of a ray is one integer: the texel in which it is, and the level at which it looks.
Hence a step is one fused loop with one result, and the time of a ray follows from its texel.

On a CPU the live rays are kept together. Every step reads all that is known of its rays: no
more of them go in step than a cache holds. On an accelerator all rays go in step to the end,
for there a step costs a launch, however many of them are done.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from jaxfx._platform import by_platform
from jaxfx._pyramid import Pyramid, minimum_pyramid
from jaxfx.reproject import _grid
from jaxfx.reproject._found import START, TOP, X_SIDE, Y_SIDE, Found
from jaxfx.reproject._grid import Moment, Rays


_BITS = 13
LARGEST = 2**_BITS
_TEXEL = LARGEST - 1
HIT, MISS = 15, 14  # as levels
# Below so many rays their bookkeeping costs more than the steps that it saves.
_FEW = 4096
# So many go in step: what more of them needed would be taken from the system anew each time.
_TOGETHER = 2**18
_LANES = 64
# One of so many rays goes on when the others are done.
_GOES_ON = 3
# So many steps for each look of an accelerator's host at whether any ray goes on.
_TURN = 6
# Down by so many levels where a ray reaches a depth; up by one beyond the border of the cell so
# many levels above. A seventh fewer steps than by single levels.
_AT_ONCE = 2
# How many cells of its first level a ray crosses, at most, on its way through all the depth.
_CELLS = 4


def pack(x: Array, y: Array, level: Array, left: Array, up: Array) -> UInt32[Array, "..."]:
    """Column, row and level as one integer, with the two signs that the ray's direction has."""
    bits = level.astype(jnp.uint32)
    for size, value in ((1, left), (1, up), (_BITS, y), (_BITS, x)):
        bits = (bits << size) | value.astype(jnp.uint32)
    return bits


def unpack(state: UInt32[Array, "..."]) -> tuple[Array, Array, Array, Array, Array]:
    """The five that were packed."""
    x, y = (state & _TEXEL).astype(jnp.int32), ((state >> _BITS) & _TEXEL).astype(jnp.int32)
    up, left = (((state >> bit) & 1).astype(jnp.int32) for bit in (2 * _BITS, 2 * _BITS + 1))
    return x, y, level_of(state).astype(jnp.int32), left, up


def level_of(state: UInt32[Array, "..."]) -> UInt32[Array, "..."]:
    """The level alone."""
    return state >> (2 * _BITS + 2)


def step(pyramid: Pyramid, r: Rays, state: UInt32[Array, " ray"]) -> UInt32[Array, " ray"]:
    """One texel of one level for every ray that is not done."""
    height, width = pyramid.shapes[0]
    x, y, level, left, up = unpack(state)
    look = jnp.minimum(level, len(pyramid.shapes) - 1)
    columns = jnp.asarray([shape[1] for shape in pyramid.shapes], jnp.int32)[look]
    offset = jnp.asarray(pyramid.offsets, jnp.int32)[look]
    node_x, node_y = x >> look, y >> look
    index = offset + node_y * columns + node_x
    nearest = pyramid.values.at[index].get(mode="promise_in_bounds")

    border_x, border_y = (node_x + 1 - left) << look, (node_y + 1 - up) << look
    leave_x = _grid.crossing(border_x, r.ox, r.ix, left)
    leave_y = _grid.crossing(border_y, r.oy, r.iy, up)
    leave = _grid.first(leave_x, leave_y)
    now = _grid.entered(r, *_grid.came(r, x, y, left, up))
    # A ray parallel to the image reaches a depth at once, -inf or NaN, or at +inf: never.
    reach = (nearest - r.oz) * r.iz
    sinks = r.iz > 0
    ahead = sinks & (now.time < reach)
    at = Moment(jnp.where(ahead, reach, now.time), now.after & ~ahead)
    sinks_in_time = (now.time < reach) | ((now.time == reach) & ~now.after)
    reached = jnp.where(sinks, _grid.earlier(at, leave), sinks_in_time) & (nearest < jnp.inf)

    # The texel in which the ray is next: where it reaches the depth, or beyond the border.
    go = Moment(jnp.where(reached, reach, leave.time), leave.after & ~reached)
    along_x = _between(_grid.cell_at(go, r.ox, r.dx, left), x, node_x, look, left)
    along_y = _between(_grid.cell_at(go, r.oy, r.dy, up), y, node_y, look, up)
    crosses_x, crosses_y = ~_grid.earlier(leave_y, leave_x), ~_grid.earlier(leave_x, leave_y)
    next_x = jnp.where(~reached & crosses_x, border_x - left, along_x)
    next_y = jnp.where(~reached & crosses_y, border_y - up, along_y)
    stays = reached & ~ahead
    next_x, next_y = jnp.where(stays, x, next_x), jnp.where(stays, y, next_y)
    near = ((next_x ^ x) | (next_y ^ y)) >> (level + _AT_ONCE) == 0
    beyond = jnp.where(near, level, level + 1)
    next_level = jnp.where(reached, jnp.maximum(level - _AT_ONCE, 0), beyond)

    hit = reached & (level == 0)
    outside = (next_x < 0) | (next_x >= width) | (next_y < 0) | (next_y >= height)
    gone = outside | (~reached & (leave.time == jnp.inf))
    next_level = jnp.where(hit, HIT, jnp.where(gone, MISS, next_level))
    next_x, next_y = jnp.where(hit | gone, x, next_x), jnp.where(hit | gone, y, next_y)
    return jnp.where(level >= MISS, state, pack(next_x, next_y, next_level, left, up))


def _between(cell: Array, start: Array, node: Array, level: Array, backward: Array) -> Array:
    """A row or column held to those of a node that the ray has not left behind."""
    first, last = node << level, ((node + 1) << level) - 1
    low, high = jnp.where(backward == 1, first, start), jnp.where(backward == 1, start, last)
    return jnp.clip(cell, low, high)


def walk(
    depth: Float[Array, "height width"],
    origin: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
    max_steps: int | None,
    from_end: bool,
) -> Found:
    """The first texel that every ray reaches in depth."""
    pyramid = minimum_pyramid(depth)
    limit = np.iinfo(np.int32).max if max_steps is None else max_steps
    finite = depth < jnp.inf
    nearest = jnp.min(jnp.where(finite, depth, jnp.inf))
    thickness = jnp.max(jnp.where(finite, depth, -jnp.inf)) - nearest

    def together(rays, walk):
        begin, along = rays
        r = _grid.rays(begin, along, from_end)
        state, steps = _begin(pyramid, thickness, r)
        return _end(pyramid, r, *walk(pyramid, r, state, steps, limit))

    def in_parts(*rays):
        count = len(origin)
        parts = -(-count // _TOGETHER)
        if parts <= 1:
            return together(rays, _walk)
        size = _even(count / parts)
        room = ((0, parts * size - count), (0, 0))
        split = tuple(jnp.pad(x, room).reshape(parts, size, 3) for x in rays)
        found = jax.lax.map(lambda part: together(part, _walk), split)
        return jax.tree.map(lambda x: x.reshape(-1)[:count], found)

    in_step = lambda *rays: together(rays, _walk_in_step)
    return by_platform(origin, direction, cpu=in_parts, accelerator=in_step)


def _begin(pyramid: Pyramid, thickness: Array, r: Rays):
    """The first step, to the nearest depth of all; then on at the size of the way that is left.

    Any level gives the same hit: it is a matter of steps, of which the root's would be many.
    """
    left, up = _grid.backward(r)
    x, y, inside = _grid.entry(r, *pyramid.shapes[0])
    x, y = (jnp.where(inside, cell, 0) for cell in (x, y))
    top = jnp.full_like(x, len(pyramid.shapes) - 1)
    state = step(pyramid, r, pack(x, y, jnp.where(inside, top, MISS), left, up))

    x, y, level, left, up = unpack(state)
    way = thickness * r.iz * jnp.maximum(jnp.abs(r.dx), jnp.abs(r.dy))
    fit = jnp.ceil(jnp.log2(jnp.maximum(way / _CELLS, 1)))
    sinks = (level < MISS) & (r.iz > 0) & (fit < level.astype(fit.dtype))
    level = jnp.where(sinks, jnp.where(sinks, fit, 0).astype(level.dtype), level)
    return pack(x, y, level, left, up), inside.astype(jnp.int32)


def _end(pyramid: Pyramid, r: Rays, state: Array, steps: Array) -> Found:
    """When and how a ray meets the texel in which it is."""
    x, y, level, left, up = unpack(state)
    when_x, when_y = _grid.came(r, x, y, left, up)
    now = _grid.entered(r, when_x, when_y).time
    texel = pyramid.values.at[y * pyramid.shapes[0][1] + x].get(mode="promise_in_bounds")
    reach = (texel - r.oz) * r.iz
    on_top = (r.iz > 0) & (reach >= now)
    side = jnp.where(when_x.time == now, X_SIDE, Y_SIDE)
    side = jnp.where(now == _grid.start(r.dz, r.from_end), START, side)
    return Found(
        time=jnp.where(on_top, reach, now),
        x=x,
        y=y,
        side=jnp.where(on_top, TOP, side),
        mask=level == HIT,
        steps=steps,
        exhausted=level < MISS,
    )


def _walk(pyramid, r, state, steps, max_steps):
    """All rays step until two thirds of them are done; then the others go on by themselves.

    So all the work is at most three times the number of steps that the rays take together.
    """
    count = len(state)
    few = 0 if count <= _FEW else _even(count / _GOES_ON)

    def goes_on(carry):
        state, steps = carry
        return jnp.sum(_alive(state, steps, max_steps), dtype=jnp.int32) > few

    def body(carry):
        state, steps = carry
        live = _alive(state, steps, max_steps)
        return jnp.where(live, step(pyramid, r, state), state), steps + live.astype(jnp.int32)

    state, steps = jax.lax.while_loop(goes_on, body, (state, steps))
    if few:
        live = _alive(state, steps, max_steps)
        place = jnp.where(live, jnp.cumsum(live, dtype=jnp.int32) - 1, few)
        numbers = jnp.arange(count, dtype=jnp.int32)
        chosen = jnp.full(few, count, jnp.int32).at[place].set(numbers, mode="drop")
        take = lambda x: x.at[chosen].get(mode="fill", fill_value=0)
        rest = jnp.where(chosen < count, take(state), jnp.uint32(MISS << (2 * _BITS + 2)))
        ends = _walk(pyramid, jax.tree.map(take, r), rest, take(steps), max_steps)
        state, steps = (
            x.at[chosen].set(end, mode="drop")
            for x, end in zip((state, steps), ends, strict=True)
        )
    return state, steps


def _walk_in_step(pyramid, r, state, steps, max_steps):
    """All rays step until the last of them is done."""

    def goes_on(carry):
        state, steps = carry
        return jnp.any(_alive(state, steps, max_steps))

    def body(carry):
        state, steps = carry
        for _ in range(_TURN):
            live = _alive(state, steps, max_steps)
            state = jnp.where(live, step(pyramid, r, state), state)
            steps = steps + live.astype(jnp.int32)
        return state, steps

    return jax.lax.while_loop(goes_on, body, (state, steps))


def _alive(state: Array, steps: Array, max_steps: int) -> Bool[Array, " ray"]:
    return (level_of(state) < MISS) & (steps < max_steps)


def _even(size: float) -> int:
    """Rounded up to what fills vectors: a loop of odd length takes a fifth longer."""
    return -(-math.ceil(size) // _LANES) * _LANES
