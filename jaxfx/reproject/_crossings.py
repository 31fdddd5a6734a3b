"""When rays cross the borders of a grid of texels, without rounding errors at corners.

Texel (j, i) covers [i, i + 1) x [j, j + 1). Hence a ray that runs towards larger x is in the
next column at the moment it crosses the border; one that runs towards smaller x, only just
after it. A crossing is therefore a time and a flag: whether it lies just `after` that time.

All four searches use these functions, in ray coordinates: x and y in texels, and a third
coordinate z that grows away from the viewer. In `warp` it is the inverse depth -1/z of a
camera, in `intersect` the depth itself.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8, Int16, Int32


# x, y and z of points or directions, each an array over rays. Of one array with three columns,
# XLA for a GPU would keep two orders where some of its readers want the columns.
Coordinates = tuple[Float[Array, " ray"], Float[Array, " ray"], Float[Array, " ray"]]

# The face through which a ray meets a texel's column: its top, a side at a border in x or in y,
# or none, because the ray starts inside the column. `_hit` uses them as indices.
TOP, X_SIDE, Y_SIDE, START = range(4)


class TexelHit(NamedTuple):
    """The first texel whose column each ray meets, as a search returns it. Not differentiated.

    - `time`: the parameter t of origin + t direction; 0 for a miss.
    - `x`, `y`: column and row of the texel, in 16 bits: a side has at most 2**13 texels.
    - `face`: one of `TOP`, `X_SIDE`, `Y_SIDE` and `START`, in 8 bits.
    - `mask`: whether there is a hit.
    - `steps`: cells of the pyramid, or points of the ray, that were compared.
    - `exhausted`: whether a bound on the steps ended the search; it counts as a miss.
    """

    time: Float[Array, " ray"]
    x: Int16[Array, " ray"]
    y: Int16[Array, " ray"]
    face: Int8[Array, " ray"]
    mask: Bool[Array, " ray"]
    steps: Int[Array, " ray"]
    exhausted: Bool[Array, " ray"]

    def read(self, values: Float[Array, "height width"]) -> Float[Array, " ray"]:
        """The value of a map in each texel; 0 for a miss."""
        place = self.y.astype(jnp.int32), self.x.astype(jnp.int32)
        return jnp.where(self.mask, values.at[place].get(mode="promise_in_bounds"), 0)


class GridRays(eqx.Module):
    """Rays on the grid: origins `o*`, directions `d*` and their reciprocals `i*`.

    No crossing time of such a ray is NaN. Rays start at time 0. With `origin_at_end`, rays that
    run away from the viewer have their origin at their end: they start at -1 and reach it at 0.
    A floating-point time near 0 keeps more digits, and in -1/z everything far away lies close
    to the end.
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
    origin_at_end: bool = eqx.field(static=True)


class Moment(NamedTuple):
    """A time, or just after it."""

    time: Float[Array, "..."]
    after: Bool[Array, "..."]


class EntryTexel(NamedTuple):
    """The texel in which a ray first is inside the image, and whether it ever is."""

    x: Int[Array, " ray"]
    y: Int[Array, " ray"]
    inside: Bool[Array, " ray"]


def coordinates(points: Float[Array, "ray 3"]) -> Coordinates:
    """x, y and z of points or directions."""
    return points[:, 0], points[:, 1], points[:, 2]


def grid_rays(
    origin: Coordinates, direction: Coordinates, origin_at_end: bool = False
) -> GridRays:
    """Rays with their reciprocals. A constant x or y is moved to the middle of its texels."""
    dx, dy, dz = (jnp.where(d == 0, 0, d) for d in direction)
    ox, oy, oz = origin
    ox = jnp.where(dx == 0, jnp.floor(ox) + 0.5, ox)
    oy = jnp.where(dy == 0, jnp.floor(oy) + 0.5, oy)
    return GridRays(ox, oy, oz, dx, dy, dz, 1 / dx, 1 / dy, 1 / dz, origin_at_end)


def crossing_moment(border: Array, o: Array, i: Array, backward: Array) -> Moment:
    """When rays cross a border of one axis: never, +inf or -inf, where they are parallel to it.

    `o` is the origin on that axis and `i` the reciprocal of the direction; `backward` says
    which rays run towards smaller coordinates.
    """
    return Moment((border.astype(o.dtype) - o) * i, backward)


def axis_entries(
    r: GridRays, x: Array, y: Array, left: Array, up: Array
) -> tuple[Moment, Moment]:
    """When rays, as lines without a start, enter column `x`, and when they enter row `y`."""
    enter_x = crossing_moment(x + as_int(left), r.ox, r.ix, left)
    enter_y = crossing_moment(y + as_int(up), r.oy, r.iy, up)
    return enter_x, enter_y


def texel_entry(r: GridRays, enter_x: Moment, enter_y: Moment) -> Moment:
    """When rays are first in both a column and a row, at their start at the earliest."""
    last = later(enter_x, enter_y)
    time = not_before_start(last.time, r.iz, r.origin_at_end)
    return Moment(time, last.after & (last.time == time))


def start_time(dz: Float[Array, "..."], origin_at_end: bool) -> Float[Array, "..."]:
    """The time at which rays start, 0 or -1; of `dz` the sign counts."""
    return not_before_start(jnp.full_like(dz, -jnp.inf), dz, origin_at_end)


def not_before_start(
    time: Float[Array, "..."], dz: Float[Array, "..."], origin_at_end: bool
) -> Float[Array, "..."]:
    """The later of a time and the start of the ray; of `dz` the sign counts.

    The maximum is taken before the choice between the starts. Otherwise XLA would carry the
    array of start times through the loop of the traversal, and read it in every step.
    """
    after_zero = jnp.maximum(time, 0)
    return jnp.where(dz > 0, jnp.maximum(time, -1), after_zero) if origin_at_end else after_zero


def is_earlier(a: Moment, b: Moment) -> Bool[Array, "..."]:
    """Whether moment `a` comes strictly before moment `b`."""
    return (a.time < b.time) | ((a.time == b.time) & ~a.after & b.after)


def later(a: Moment, b: Moment) -> Moment:
    """The later of two moments."""
    after = jnp.where(a.time < b.time, b.after, a.after)
    after = jnp.where(a.time == b.time, a.after | b.after, after)
    return Moment(jnp.maximum(a.time, b.time), after)


def texel_at(moment: Moment, o: Array, d: Array, backward: Array) -> Int[Array, "..."]:
    """The row or column in which rays are at a moment."""
    coordinate = o + moment.time * d
    has_crossed = moment.after & backward
    texel = jnp.where(has_crossed, jnp.ceil(coordinate) - 1, jnp.floor(coordinate))
    return texel.astype(jnp.int32)


def backward_axes(r: GridRays) -> tuple[Bool[Array, " ray"], Bool[Array, " ray"]]:
    """Which rays run to the left, and which upwards."""
    return r.dx < 0, r.dy < 0


def as_int(flags: Bool[Array, "..."]) -> Int32[Array, "..."]:
    """Flags as 1 and 0."""
    return flags.astype(jnp.int32)


def entry_texel(r: GridRays, height: int, width: int) -> EntryTexel:
    """The texel at which rays enter the image, or that in which they start."""
    left, up = backward_axes(r)
    edge_x, edge_y = as_int(left) * (width - 1), as_int(up) * (height - 1)
    enter_x, enter_y = axis_entries(r, edge_x, edge_y, left, up)
    entry = texel_entry(r, enter_x, enter_y)
    x_then, y_then = texel_at(entry, r.ox, r.dx, left), texel_at(entry, r.oy, r.dy, up)
    x = _not_outside(edge_x, left, x_then, is_earlier(enter_x, entry))
    y = _not_outside(edge_y, up, y_then, is_earlier(enter_y, entry))
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    is_finite = jnp.isfinite(r.ox + r.oy + r.oz) & jnp.isfinite(r.dx + r.dy + r.dz)
    return EntryTexel(x, y, inside & is_finite)


def _not_outside(edge: Array, backward: Array, texel: Array, has_passed: Array) -> Array:
    """The row or column of a ray that enters at `edge`, whatever the rounding of `texel`.

    It is `edge` itself where the ray has not passed it, and never on the outer side of it.
    """
    inner = jnp.where(backward, jnp.minimum(texel, edge), jnp.maximum(texel, edge))
    return jnp.where(has_passed, inner, edge)
