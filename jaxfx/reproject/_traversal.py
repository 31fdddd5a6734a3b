"""The exact search: a traversal of a minimum pyramid, many rays at a time.

Rays run over the grid of a height field. Each texel is a solid column that begins at the
texel's value in z and extends to infinity. The search finds the first column that a ray meets.

The state of a ray is one integer: the texel in which it is, and the level of the pyramid that
it reads next. So one step of all rays is one fused loop with one result. The time (the ray's
parameter) is not stored: it follows from the texel.

A step reads the cell of that level that holds the texel. If the ray reaches the cell's nearest
value before it leaves the cell, the ray moves there and goes down in levels; at level 0 that
is the hit. Otherwise it moves beyond the cell's border and may go up.

Two programs step the rays. On a CPU the unfinished rays are packed together, in batches that
fit the cache. On an accelerator a step costs a launch, however many rays are finished, so all
rays step until the last one is done.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int32

from jaxfx._loops import while_loop
from jaxfx._platform import by_platform
from jaxfx._pyramid import Pyramid, minimum_pyramid
from jaxfx.reproject._crossings import (
    START,
    TOP,
    X_SIDE,
    Y_SIDE,
    Coordinates,
    GridRays,
    Moment,
    TexelHit,
    as_int,
    axis_entries,
    backward_axes,
    crossing_moment,
    entry_texel,
    grid_rays,
    is_earlier,
    start_time,
    texel_at,
    texel_entry,
)


# Bits of a state for the level, for the texel's x, and for its y. With 2 for directions: 32.
_LEVEL_BITS, _TEXEL_BITS = 4, 13
# The largest height and width in texels: what 13 bits count. Checked for every argument.
LARGEST_SIDE = 2**_TEXEL_BITS
# Values in place of a level that mean that a ray is done. Real levels are 0 to 13.
HIT, MISS = 15, 14
# Rays. Up to this number rays are not packed: that would cost more than the steps saved.
# Measured; a wrong value costs time only.
_MIN_PACKED_RAYS = 4096
# Rays per batch on a CPU. Above this the temporaries exceed 32 MB and are reallocated on every
# call. A wrong value costs time only.
_BATCH_RAYS = 2**18
# Rays. Batch sizes are multiples of this, so that vector loops have no remainder: a loop of
# odd length takes a fifth longer. A wrong value costs time only.
_LANES = 64
# A ratio. Unfinished rays are packed once they are at most 1 in 3: the steps computed are then
# at most three times those needed. A wrong value costs time only.
_PACKING_RATIO = 3
# Steps after which an accelerator's host checks whether any ray is unfinished. Each check waits
# for the device; up to 2 steps are wasted at the end. A relief of 256 to 1024 pixels a side
# takes 6 to 21 steps in all. More steps between checks take longer to compile. A wrong value
# costs time only.
_STEPS_PER_CHECK = 3
# Levels. A ray goes down by this many where it reaches a value. It goes up by one where it also
# leaves the cell that lies this many levels above. Measured: a seventh fewer steps than with 1.
# Any value gives the same hit.
_LEVEL_STRIDE = 2
# Cells. The first level is such that a ray crosses at most 4 of its cells between the nearest
# and the farthest value. Measured. Any value gives the same hit.
_START_CELLS = 4


def pack(x: Array, y: Array, level: Array, left: Array, up: Array) -> Int32[Array, "..."]:
    """The state of rays in texel (x, y). From the lowest bit: level, x, y, left, up.

    `left` and `up` are 1 for a ray that runs towards smaller x and towards smaller y, else 0.
    They follow from the ray's direction. If they were not in the state, XLA would compute them
    once for all steps, and each step would read them as further arrays.
    """
    bits = up << 1 | left
    for size, value in ((_TEXEL_BITS, y), (_TEXEL_BITS, x), (_LEVEL_BITS, level)):
        bits = bits << size | value
    return bits


def unpack(state: Int32[Array, "..."]) -> tuple[Array, Array, Array, Array, Array]:
    """The arguments of `pack`, from its result."""
    x_bit, y_bit = _LEVEL_BITS, _LEVEL_BITS + _TEXEL_BITS
    x, y = ((state >> bit) & (LARGEST_SIDE - 1) for bit in (x_bit, y_bit))
    left, up = ((state >> bit) & 1 for bit in (y_bit + _TEXEL_BITS, y_bit + _TEXEL_BITS + 1))
    return x, y, level_of(state), left, up


def level_of(state: Int32[Array, "..."]) -> Int32[Array, "..."]:
    """The level of a state."""
    return state & (2**_LEVEL_BITS - 1)


def step(pyramid: Pyramid, r: GridRays, state: Int32[Array, " ray"]) -> Int32[Array, " ray"]:
    """The states after each ray has read one cell; of no use for rays that are done."""
    height, width = pyramid.shapes[0]
    x, y, level, left, up = unpack(state)
    runs_left, runs_up = left == 1, up == 1
    cell_x, cell_y = x >> level, y >> level
    nearest = _cell_value(pyramid, cell_x, cell_y, level)

    # The borders through which the ray leaves the cell, and the texels before and beyond them.
    border_x = (cell_x + (1 - left)) << level
    border_y = (cell_y + (1 - up)) << level
    last_x, last_y = border_x - (1 - left), border_y - (1 - up)
    beyond_x, beyond_y = border_x - left, border_y - up
    leave_x = crossing_moment(border_x, r.ox, r.ix, runs_left)
    leave_y = crossing_moment(border_y, r.oy, r.iy, runs_up)
    crosses_x, crosses_y = ~is_earlier(leave_y, leave_x), ~is_earlier(leave_x, leave_y)
    leave_time = jnp.minimum(leave_x.time, leave_y.time)
    # Where both are crossed at one moment, both flags are alike.
    leave = Moment(leave_time, jnp.where(crosses_x, runs_left, runs_up))
    now = texel_entry(r, *axis_entries(r, x, y, runs_left, runs_up))
    # Without motion in z the time is -inf or NaN where the ray is behind the value, else +inf.
    reach_time = (nearest - r.oz) * r.iz
    recedes = r.iz > 0
    is_ahead = recedes & (now.time < reach_time)
    meeting = Moment(jnp.where(is_ahead, reach_time, now.time), now.after & ~is_ahead)
    is_behind_now = (now.time < reach_time) | ((now.time == reach_time) & ~now.after)
    reached = jnp.where(recedes, is_earlier(meeting, leave), is_behind_now)
    reached = reached & (nearest < jnp.inf)

    # The next texel: where the ray reaches the value, or beyond the border of the cell.
    next_moment = Moment(jnp.where(reached, reach_time, leave.time), leave.after & ~reached)
    x_then = texel_at(next_moment, r.ox, r.dx, runs_left)
    y_then = texel_at(next_moment, r.oy, r.dy, runs_up)
    next_x = jnp.where(~reached & crosses_x, beyond_x, _between(x_then, x, last_x))
    next_y = jnp.where(~reached & crosses_y, beyond_y, _between(y_then, y, last_y))
    stays = reached & ~is_ahead
    next_x, next_y = jnp.where(stays, x, next_x), jnp.where(stays, y, next_y)
    in_same_ancestor = ((next_x ^ x) | (next_y ^ y)) >> (level + _LEVEL_STRIDE) == 0
    level_beyond = jnp.where(in_same_ancestor, level, level + 1)
    next_level = jnp.where(reached, jnp.maximum(level - _LEVEL_STRIDE, 0), level_beyond)

    next_level = jnp.where(reached & (level == 0), HIT, next_level)
    is_outside = ((next_x | next_y) < 0) | (next_x >= width) | (next_y >= height)
    is_miss = is_outside | (~reached & (leave.time == jnp.inf))
    next_state = pack(next_x, next_y, next_level, left, up)
    return jnp.where(is_miss, _missed(state), next_state)


def _cell_value(pyramid: Pyramid, cell_x: Array, cell_y: Array, level: Array) -> Array:
    """The values of cells of any level.

    A state that is done has a level above the last one. It reads the last one, which is of no
    use to it, but inside the array.
    """
    of_level = np.full(2**_LEVEL_BITS, pyramid.offsets[-1], np.int32)
    of_level[: len(pyramid.shapes)] = pyramid.offsets
    read = lambda values, index: values.at[index].get(
        mode="promise_in_bounds", wrap_negative_indices=False
    )
    columns = (pyramid.shapes[0][1] - 1 >> level) + 1
    return read(pyramid.values, read(jnp.asarray(of_level), level) + cell_y * columns + cell_x)


def _between(texel: Array, a: Array, b: Array) -> Array:
    """A row or column, or the nearer of two others where it does not lie between them."""
    return jnp.clip(texel, jnp.minimum(a, b), jnp.maximum(a, b))


def _missed(state: Int32[Array, "..."]) -> Int32[Array, "..."]:
    """The state of rays that were in this one, and meet nothing."""
    return state & ~(2**_LEVEL_BITS - 1) | MISS


def traverse(
    height_field: Float[Array, "height width"],
    origin: Coordinates,
    direction: Coordinates,
    max_steps: int | None,
    origin_at_end: bool,
) -> TexelHit:
    """The first texel whose column each ray meets: exact, as if every texel were compared."""
    pyramid = minimum_pyramid(height_field)
    limit = np.iinfo(np.int32).max if max_steps is None else max_steps
    is_finite = height_field < jnp.inf
    nearest = jnp.min(jnp.where(is_finite, height_field, jnp.inf))
    thickness = jnp.max(jnp.where(is_finite, height_field, -jnp.inf)) - nearest

    def hits(rays):
        origin, direction = rays
        r = grid_rays(origin, direction, origin_at_end)
        states = _first_states(pyramid, thickness, r)
        return _texel_hits(pyramid, r, *_step_packed(pyramid, r, *states, limit))

    def in_batches(*rays):
        count = len(origin[0])
        batches = -(-count // _BATCH_RAYS)
        if batches <= 1:
            return hits(rays)
        size = _whole_lanes(count / batches)
        padding = (0, batches * size - count)
        split = jax.tree.map(lambda x: jnp.pad(x, padding).reshape(batches, size), rays)
        texel_hits = jax.lax.map(hits, split)
        return jax.tree.map(lambda x: x.reshape(-1)[:count], texel_hits)

    def all_at_once(*rays):
        return _all_hits(pyramid, thickness, rays, limit, origin_at_end)

    return by_platform(origin, direction, cpu=in_batches, accelerator=all_at_once)


def _first_states(pyramid: Pyramid, thickness: Array, r: GridRays):
    """States and step counts after the first step, which moves to the nearest value of all.

    The level is then set by the number of texels that the ray crosses between the nearest and
    the farthest value (their difference is `thickness`): at most `_START_CELLS` cells. Any
    level gives the same hit; from the root it would take many more steps.
    """
    x, y, inside = entry_texel(r, *pyramid.shapes[0])
    x, y = (jnp.where(inside, texel, 0) for texel in (x, y))
    root = jnp.full_like(x, len(pyramid.shapes) - 1)
    state = pack(x, y, root, *map(as_int, backward_axes(r)))
    state = jnp.where(inside, step(pyramid, r, state), _missed(state))

    x, y, level, left, up = unpack(state)
    texels = thickness * r.iz * jnp.maximum(jnp.abs(r.dx), jnp.abs(r.dy))
    fitting = jnp.ceil(jnp.log2(jnp.maximum(texels / _START_CELLS, 1)))
    lowers = (level < MISS) & (r.iz > 0) & (fitting < level.astype(fitting.dtype))
    level = jnp.where(lowers, jnp.where(lowers, fitting, 0).astype(level.dtype), level)
    return pack(x, y, level, left, up), inside.astype(jnp.int32)


def _texel_hits(pyramid: Pyramid, r: GridRays, state: Array, steps: Array) -> TexelHit:
    """When, and through which face, rays meet the texels of their final states."""
    x, y, level, left, up = unpack(state)
    enter_x, enter_y = axis_entries(r, x, y, left == 1, up == 1)
    entry_time = texel_entry(r, enter_x, enter_y).time
    texel = pyramid.values.at[y * pyramid.shapes[0][1] + x].get(mode="promise_in_bounds")
    reach_time = (texel - r.oz) * r.iz
    on_top = (r.iz > 0) & (reach_time >= entry_time)
    face = jnp.where(enter_x.time == entry_time, X_SIDE, Y_SIDE)
    face = jnp.where(entry_time == start_time(r.dz, r.origin_at_end), START, face)
    return TexelHit(
        time=jnp.where(on_top, reach_time, entry_time),
        x=x.astype(jnp.int16),
        y=y.astype(jnp.int16),
        face=jnp.where(on_top, TOP, face).astype(jnp.int8),
        mask=level == HIT,
        steps=steps,
        exhausted=level < MISS,
    )


def _step_packed(pyramid, r, state, steps, max_steps):
    """The final states and step counts on a CPU.

    All rays step until two thirds of them are done. The others are then packed together and
    go on, by this function again.
    """
    count = len(state)
    packed_count = 0 if count <= _MIN_PACKED_RAYS else _whole_lanes(count / _PACKING_RATIO)

    def goes_on(carry):
        state, steps = carry
        unfinished = jnp.sum(_is_unfinished(state, steps, max_steps), dtype=jnp.int32)
        return unfinished > packed_count

    def body(carry):
        state, steps = carry
        unfinished = _is_unfinished(state, steps, max_steps)
        state = jnp.where(unfinished, step(pyramid, r, state), state)
        return state, steps + unfinished.astype(jnp.int32)

    state, steps = while_loop(goes_on, body, (state, steps))
    if packed_count:
        unfinished = _is_unfinished(state, steps, max_steps)
        slot = jnp.where(unfinished, jnp.cumsum(unfinished, dtype=jnp.int32) - 1, packed_count)
        ray = jnp.arange(count, dtype=jnp.int32)
        packed = jnp.full(packed_count, count, jnp.int32).at[slot].set(ray, mode="drop")
        take = lambda x: x.at[packed].get(mode="fill", fill_value=0)
        rest = jnp.where(packed < count, take(state), jnp.int32(MISS))
        rest = _step_packed(pyramid, jax.tree.map(take, r), rest, take(steps), max_steps)
        state, steps = (
            x.at[packed].set(final, mode="drop")
            for x, final in zip((state, steps), rest, strict=True)
        )
    return state, steps


def _all_hits(pyramid, thickness, rays, max_steps, origin_at_end) -> TexelHit:
    """The hits on an accelerator: all rays step to the end.

    - `rays`: origins and directions. What a step needs beside them it computes again, which
      takes less time than to read it.

    Where nothing bounds the steps the loop does not read their counts: XLA then leaves out
    those that nobody asks for, and keeps one state per ray instead of seven.
    """

    def read(rays, *states):
        """The rays on the grid, and the states, out of memory.

        XLA else keeps the reciprocals through the loop, or joins a step with the next.
        """
        (origin, direction), *states = jax.lax.optimization_barrier((rays, *states))
        return grid_rays(origin, direction, origin_at_end), *states

    def is_unfinished(state, steps):
        if max_steps == np.iinfo(np.int32).max:
            return level_of(state) < MISS
        return _is_unfinished(state, steps, max_steps)

    def goes_on(carry):
        return _any(is_unfinished(*carry))

    def body(carry):
        state, steps = carry
        for _ in range(_STEPS_PER_CHECK):
            r, state = read(rays, state)
            unfinished = is_unfinished(state, steps)
            state = jnp.where(unfinished, step(pyramid, r, state), state)
            steps = steps + unfinished.astype(jnp.int32)
        return state, steps

    r, *_ = read(rays)
    state, steps = while_loop(goes_on, body, _first_states(pyramid, thickness, r))
    r, state = read(rays, state)
    # Kept in memory: who reads the hits would else compute them again.
    return jax.lax.optimization_barrier(_texel_hits(pyramid, r, state, steps))


@custom_vmap
def _any(flags: Bool[Array, "*ray"]) -> Bool[Array, ""]:
    """Whether any flag is set, of a batch in any of its members."""
    return jnp.any(flags)


@_any.def_vmap
def _any_of_batch(_size, is_batched, flags):
    return _any(flags), False


def _is_unfinished(state: Array, steps: Array, max_steps: int) -> Bool[Array, " ray"]:
    return (level_of(state) < MISS) & (steps < max_steps)


def _whole_lanes(rays: float) -> int:
    """A number of rays, rounded up to a multiple of `_LANES`."""
    return -(-math.ceil(rays) // _LANES) * _LANES
