"""The four searches for the first texel that a ray meets, under one call.

"pyramid" is exact; its traversal is in `_traversal`. The other three are kept as baselines:
"descent", the published descent of a pyramid, "linear", parallax occlusion mapping, and
"relief", relief mapping. Each of them may miss a hit or find a later one.

They search a `height_field`: for each texel the third ray coordinate at which its column
begins, growing away from the viewer; +inf where there is none. `warp` passes the inverse depth
-1/z, `intersect` the depth.
"""

import functools

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from jaxfx._loops import fori_loop
from jaxfx._meshes import each_device
from jaxfx._platform import of_batches
from jaxfx._pyramid import Pyramid, minimum_pyramid
from jaxfx.reproject._crossings import (
    START,
    TOP,
    Coordinates,
    EntryTexel,
    GridRays,
    TexelHit,
    as_int,
    axis_entries,
    backward_axes,
    crossing_moment,
    entry_texel,
    grid_rays,
    start_time,
    texel_entry,
)
from jaxfx.reproject._traversal import traverse


# Equal steps of "linear" and "relief" by default. The errors at other numbers are in
# tests/reproject/test_searches.py; a change alters what they find.
_DEFAULT_STEPS = 64
# Bisections of "relief": its hit lies within 1/256 of a step of the crossing. A change alters
# what it finds.
_BISECTIONS = 8


def first_crossing(
    height_field: Float[Array, "height width"],
    origin: Coordinates,
    direction: Coordinates,
    search: str,
    max_steps: int | None,
    *,
    origin_at_end: bool = False,
) -> TexelHit:
    """The first texel that each ray meets, by the search of that name.

    Nothing is differentiated: no derivative passes through a loop. `GridRays` says what
    `origin_at_end` means. The time of a miss is set to 0: a derivative multiplies it by 0, and
    an infinite time would make that NaN. Under `vmap` the cost is that of all rays together.
    """
    held = map(jax.lax.stop_gradient, (height_field, *origin, *direction))
    hit = _batchable(search, max_steps, origin_at_end)(*held)
    return hit._replace(time=jnp.where(hit.mask, hit.time, 0))


@functools.cache
def _batchable(search: str, max_steps: int | None, origin_at_end: bool):
    function = _SEARCHES[search]

    def single(height_field, *rays):
        return function(height_field, rays[:3], rays[3:], max_steps, origin_at_end)

    return _of_batches(single, ())


def _of_batches(search, levels: tuple[list[bool], ...]):
    """A search with a rule for `vmap`: rays of a batch on one height field are concatenated.

    The rays are six arrays, the coordinates of origins and directions. `levels` are those of
    `of_batches`. On a CPU, batches of height fields go one by one: a loop under `vmap` would
    run every search as long as the longest.
    """
    batchable = custom_vmap(each_device(search, levels) if levels else search)

    @batchable.def_vmap
    def batch(size, is_batched, height_field, *rays):
        rays = [
            ray if has_axis else jnp.broadcast_to(ray, (size, *ray.shape))
            for ray, has_axis in zip(rays, is_batched[1:], strict=True)
        ]
        is_batched = [is_batched[0], *[True] * len(rays)]
        more = is_batched, *levels
        if is_batched[0]:
            in_turn = lambda *data: jax.lax.map(lambda items: search(*items), data)
            found = of_batches(in_turn, jax.vmap(search), more)(height_field, *rays)
        else:
            found = _of_batches(_concatenated(search), more)(height_field, *rays)
        return found, jax.tree.map(lambda _: True, found)

    return batchable


def _concatenated(search):
    """A search for a batch of rays, of all members together."""

    def together(height_field, *rays):
        merged = [ray.reshape(-1) for ray in rays]
        found = search(height_field, *merged)
        return jax.tree.map(lambda x: x.reshape(*rays[0].shape[:2], *x.shape[1:]), found)

    return together


def descend(
    height_field: Float[Array, "height width"],
    origin: Coordinates,
    direction: Coordinates,
    max_steps: int | None,
    origin_at_end: bool,
) -> TexelHit:
    """The published descent: from the root of the pyramid to a leaf, one cell per level.

    At each level the ray moves on to the value of the cell that it is in. The cell's borders
    are ignored: the ray may have left it before, and have passed the true hit.
    """
    r, entry = _rays_and_entry(height_field, origin, direction, origin_at_end)
    pyramid = minimum_pyramid(height_field)
    time, _ = _time_range(height_field, r, entry)
    levels = len(pyramid.shapes) if max_steps is None else min(len(pyramid.shapes), max_steps)
    nearest = jnp.full_like(time, jnp.inf)
    for level in reversed(range(len(pyramid.shapes) - levels, len(pyramid.shapes))):
        nearest = _cell_value(pyramid, level, *_xy_at(r, time))
        reach_time = (nearest - r.oz) * r.iz
        moves = (r.dz > 0) & (reach_time > time) & (nearest < jnp.inf)
        time = jnp.where(moves, reach_time, time)
    x, y = _xy_at(r, time)
    inside = (x >= 0) & (y >= 0) & (x < height_field.shape[1]) & (y < height_field.shape[0])
    is_reached = jnp.where(r.dz > 0, nearest < jnp.inf, r.oz + time * r.dz >= nearest)
    steps = jnp.where(entry.inside, levels, 0)
    mask = entry.inside & inside & is_reached
    is_complete = levels == len(pyramid.shapes)
    return _texel_hit(height_field, r, time, x, y, mask & is_complete, steps)._replace(
        exhausted=entry.inside & (not is_complete)
    )


def linear(
    height_field: Float[Array, "height width"],
    origin: Coordinates,
    direction: Coordinates,
    max_steps: int | None,
    origin_at_end: bool,
) -> TexelHit:
    """Parallax occlusion: equal steps until a ray is behind the field, then one secant step."""
    r, entry = _rays_and_entry(height_field, origin, direction, origin_at_end)
    before, after, mask, steps = _first_step_behind(height_field, r, entry, max_steps)
    gap_before, gap_after = (_gap(height_field, r, time) for time in (before, after))
    has_secant = mask & jnp.isfinite(gap_before) & (gap_before < 0)
    rise = jnp.where(has_secant, gap_after - gap_before, 1)
    fraction = jnp.where(has_secant, -gap_before / rise, 1)
    time = before + fraction * (after - before)
    return _texel_hit(height_field, r, time, *_xy_at(r, time), mask, steps)


def relief(
    height_field: Float[Array, "height width"],
    origin: Coordinates,
    direction: Coordinates,
    max_steps: int | None,
    origin_at_end: bool,
) -> TexelHit:
    """Relief mapping: equal steps until a ray is behind the field, then bisection."""
    r, entry = _rays_and_entry(height_field, origin, direction, origin_at_end)
    before, after, mask, steps = _first_step_behind(height_field, r, entry, max_steps)

    def bisect(_, times):
        before, after = times
        middle = (before + after) / 2
        is_behind = _gap(height_field, r, middle) >= 0
        return jnp.where(is_behind, before, middle), jnp.where(is_behind, middle, after)

    _, time = fori_loop(0, _BISECTIONS, bisect, (before, after))
    steps = steps + jnp.where(mask, _BISECTIONS, 0)
    return _texel_hit(height_field, r, time, *_xy_at(r, time), mask, steps)


# The searches by the names that `intersect`, `warp` and `blend` accept.
_SEARCHES = {"pyramid": traverse, "descent": descend, "linear": linear, "relief": relief}


def _rays_and_entry(
    height_field: Array, origin: Coordinates, direction: Coordinates, origin_at_end: bool
) -> tuple[GridRays, EntryTexel]:
    r = grid_rays(origin, direction, origin_at_end)
    return r, entry_texel(r, *height_field.shape)


def _first_step_behind(
    height_field: Array, r: GridRays, entry: EntryTexel, max_steps: int | None
):
    """The first of equal steps at whose end a ray is behind the field.

    Returns the times before and after it, whether there is one, and the steps taken.
    """
    count = _DEFAULT_STEPS if max_steps is None else max_steps
    start, end = _time_range(height_field, r, entry)
    length = (end - start) / count

    def compare(index, first):
        gap = _gap(height_field, r, start + index.astype(start.dtype) * length)
        return jnp.where((gap >= 0) & (first > count), index.astype(jnp.int32), first)

    first = jnp.where(entry.inside, count + 1, 0).astype(jnp.int32)
    first = fori_loop(0, count + 1, compare, first)
    mask = entry.inside & (first <= count)
    after = start + first.astype(start.dtype) * length
    before = jnp.where(first == 0, after, after - length)
    steps = jnp.where(entry.inside, jnp.minimum(first, count) + 1, 0)
    before, after = (jnp.where(mask, time, start) for time in (before, after))
    return before, after, mask, steps.astype(jnp.int32)


def _time_range(height_field: Array, r: GridRays, entry: EntryTexel) -> tuple[Array, Array]:
    """When rays enter the image, and when they leave it or are behind the whole field."""
    height, width = height_field.shape
    left, up = backward_axes(r)
    x, y = (jnp.where(entry.inside, texel, 0) for texel in (entry.x, entry.y))
    start = texel_entry(r, *axis_entries(r, x, y, left, up)).time
    leave_x = crossing_moment((1 - as_int(left)) * width, r.ox, r.ix, left).time
    leave_y = crossing_moment((1 - as_int(up)) * height, r.oy, r.iy, up).time
    farthest = jnp.max(jnp.where(height_field < jnp.inf, height_field, -jnp.inf))
    # A margin for rounding: the last step must be behind the farthest texel as well.
    terms = jnp.abs(farthest) + jnp.abs(r.oz) + jnp.abs(start * r.dz)
    margin = 8 * jnp.finfo(height_field.dtype).eps * terms
    behind_all = (farthest + margin - r.oz) * r.iz
    behind_all = jnp.where((r.dz > 0) & (farthest > -jnp.inf), behind_all, jnp.inf)
    end = jnp.minimum(jnp.minimum(leave_x, leave_y), behind_all)
    start = jnp.where(entry.inside, start, 0)
    return start, jnp.where(end < jnp.inf, jnp.maximum(end, start), start)


def _xy_at(r: GridRays, time: Array) -> tuple[Int[Array, " ray"], Int[Array, " ray"]]:
    """The column and row at a time, which may lie outside the image."""
    texels = jnp.floor(r.ox + time * r.dx), jnp.floor(r.oy + time * r.dy)
    x, y = (jnp.clip(texel, -1, 2**30).astype(jnp.int32) for texel in texels)
    return x, y


def _cell_value(pyramid: Pyramid, level: int, x: Array, y: Array) -> Float[Array, " ray"]:
    """The cell of a level that holds texel (x, y), or the nearest one of the image."""
    height, width = pyramid.shapes[level]
    column = jnp.clip(x >> level, 0, width - 1)
    row = jnp.clip(y >> level, 0, height - 1)
    return pyramid.values[pyramid.offsets[level] + row * width + column]


def _gap(height_field: Array, r: GridRays, time: Array) -> Float[Array, " ray"]:
    """The ray's third coordinate less the field's: 0 or more where the ray is behind it."""
    height, width = height_field.shape
    x, y = _xy_at(r, time)
    value = height_field[jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)]
    return r.oz + time * r.dz - value


def _texel_hit(height_field, r, time, x, y, mask, steps) -> TexelHit:
    """The record of a hit on a top; at the start time the ray is inside the column."""
    height, width = height_field.shape
    x, y = (jnp.clip(v, 0, size - 1).astype(jnp.int16) for v, size in ((x, width), (y, height)))
    face = jnp.where(time > start_time(r.dz, r.origin_at_end), TOP, START).astype(jnp.int8)
    return TexelHit(time, x, y, face, mask, steps.astype(jnp.int32), jnp.zeros_like(mask))
