"""The rim of a lens: a second disc that cuts an opening, the farther off the axis the more.

The outline of the opening is drawn in to the disc: each point outside moves towards the disc's
centre until it lies on its circle. What is left of a line or an arc stays a line or an arc;
around each corner that is cut off the outline follows the circle. By Green's theorem areas are
integrals along that closed curve, exact wherever the disc's centre is.
"""

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


if TYPE_CHECKING:
    from jaxfx.dof.iris import Pieces


class Rim(NamedTuple):
    """The second disc, of radius 1, and the arcs of its circle, one for each corner, per pixel.

    - `center`: x and y. The arcs' ends are given from there.
    - `start`, `end`: x and y; the same point where the corner is not cut off.
    - `turns`: how often the arc passes the lowest point, 1 anticlockwise and -1 clockwise.
    - `start_area`, `end_area`: `_half_area` at the heights of the ends.
    """

    center: Float[Array, "2 height width"]
    start: Float[Array, "arc 2 height width"]
    end: Float[Array, "arc 2 height width"]
    turns: Float[Array, "arc height width"]
    start_area: Float[Array, "arc height width"]
    end_area: Float[Array, "arc height width"]


def field_of(
    height: int, width: int, dtype: Any, margin: int = 0
) -> Float[Array, "2 height width"]:
    """Where each pixel's centre lies from the image's, in halves of the diagonal, x and y.

    The frame has a `margin` around it, which belongs to the height and the width. Where that
    lies farther off than a corner of the frame it counts as that far, in its direction.
    """
    diagonal = math.hypot(height - 2 * margin, width - 2 * margin)
    along = lambda n: (2 * jnp.arange(n, dtype=dtype) + (1 - n)) / diagonal
    field = jnp.stack(jnp.meshgrid(along(width), along(height)))
    if margin == 0:
        return field
    return field / jnp.maximum(jnp.sqrt(jnp.sum(field * field, axis=0)), 1)[None]


def center_of(
    vignetting: Float[Array, ""], field: Float[Array, "2 height width"]
) -> Float[Array, "2 height width"]:
    """The second disc's centre: the front rim moves against the field."""
    return -vignetting * field


def quarters(dtype: Any) -> tuple[Float[Array, "4 2"], Float[Array, "4 2"]]:
    """Corners that part the unit circle in arcs along which y does not turn; their normals."""
    corners = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    normals = (corners + np.roll(corners, -1, axis=0)) * math.sqrt(0.5)
    return jnp.asarray(corners, dtype), jnp.asarray(normals, dtype)


def rimmed(
    pieces: "Pieces",
    half: float,
    curvature: Float[Array, ""] | None,
    center: Float[Array, "2 height width"],
    toward: Float[Array, "2 height width"] | None,
) -> tuple["Pieces", Rim]:
    """The outline's pieces cut by the second disc, per pixel, and the arcs that close the gaps.

    The pieces follow one another. `half` is half of the longest chord. `toward` is the
    direction of `center`, and says that the pieces are of the unit circle: the two circles then
    cross at right angles to it, even where they are one.
    """
    first, last, middle, normal = (x[:, :, None, None] for x in pieces)
    to_middle = middle - center[None]
    if toward is not None:
        normal_of_cut, distance = toward[None], -_dot(toward[None], center[None]) / 2
        # Where both circles are one, as if the disc had begun to move.
        is_out = _dot(first, normal_of_cut) <= -distance
    else:
        # The line through both crossings of the piece's circle, or its line, with the disc's.
        if curvature is None:
            normal_of_cut, distance = normal, _dot(to_middle, normal)
        else:
            facing = jnp.sqrt(1 - (curvature * half) ** 2)
            apothem = math.sqrt(1 - half * half)
            across = (facing - curvature * apothem) * normal + curvature * center[None]
            length = _square(across)
            is_line = length > jnp.finfo(length.dtype).tiny
            length = jnp.sqrt(jnp.where(is_line, length, 1))
            normal_of_cut = jnp.where(is_line[:, None], across / length[:, None], normal)
            bulge = curvature / 2 * (half * half - 1 - _square(to_middle))
            distance = (bulge + facing * _dot(to_middle, normal)) / length
        # On the axis the opening lies within, and blades as round as the circle are all on it.
        is_aside = _square(center[None]) > jnp.finfo(center.dtype).eps
        is_out = (_square(first - center[None]) > 1) & is_aside
    # The floor is nothing beside a radius, and keeps the root's derivatives finite.
    reach = jnp.sqrt(jnp.maximum(1 - distance**2, jnp.finfo(distance.dtype).eps))[:, None]
    foot = distance[:, None] * normal_of_cut
    along = jnp.stack([-normal_of_cut[:, 1], normal_of_cut[:, 0]], axis=1)
    enters, leaves = foot - reach * along, foot + reach * along  # From the disc's centre.

    is_out_after = jnp.roll(is_out, -1, axis=0)
    start = jnp.where(is_out[:, None], enters, first - center[None])
    end = jnp.where(is_out_after[:, None], leaves, last - center[None])
    # With both ends cut off there is a rest if the line's foot is on the piece.
    tangent = jnp.concatenate([-normal[:, 1:], normal[:, :1]], axis=1)
    place = _dot(foot - to_middle, tangent)
    low, high = (_dot(x - middle, tangent) for x in (first, last))
    is_near = _dot(foot - to_middle, normal) > -0.5
    is_rest = (place > low) & (place < high) & is_near & (jnp.abs(distance) < 1)
    is_gone = is_out & is_out_after & ~is_rest
    outside = jnp.where(is_gone[:, None], first - center[None], 1)
    drawn = outside / jnp.sqrt(_square(outside))[:, None]
    start, end = (jnp.where(is_gone[:, None], drawn, x) for x in (start, end))

    before = jnp.roll(end, 1, axis=0)
    is_cut = is_out[:, None]
    arc_start, arc_end = (jnp.where(is_cut, x, 0) for x in (before, start))
    turns = _turns(arc_start, arc_end)
    areas = (_half_area(x[:, 1]) for x in (arc_start, arc_end))
    rim = Rim(center, arc_start, arc_end, turns, *areas)
    start, end = start + center[None], end + center[None]
    return pieces._replace(start=start, end=end), rim


def _turns(
    start: Float[Array, "arc 2 height width"], end: Float[Array, "arc 2 height width"]
) -> Float[Array, "arc height width"]:
    """How often arcs of at most half a circle pass its lowest point, 1 for anticlockwise."""
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    # Half a circle, which rounding may make a little more, is left of the axis.
    is_half = (_dot(start, end) < 0) & (cross > -1e-4)
    is_anticlockwise = (cross > 0) | is_half
    is_right, is_right_after = start[:, 0] >= 0, end[:, 0] >= 0
    is_left_half = is_right & is_right_after & (start[:, 1] > end[:, 1] + 1)
    passes = (~is_right & is_right_after) | is_left_half
    turns = jnp.where(passes & is_anticlockwise, 1, 0)
    return jnp.where(is_right & ~is_right_after & ~is_anticlockwise, -1, turns).astype(
        start.dtype
    )


def _dot(a, b):
    return jnp.sum(a * b, axis=1)


def _square(a):
    return jnp.sum(a * a, axis=1)


@jax.custom_jvp
def _half_area(height: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The integral of `sqrt(1 - t**2)` from 0 to a height, which may lie beyond the circle."""
    height = jnp.clip(height, -1, 1)
    return (height * _half_chord(height) + jnp.arcsin(height)) / 2


def _half_chord(height: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    square = (1 - height) * (1 + height)
    return jnp.sqrt(jnp.maximum(square, math.sqrt(jnp.finfo(square.dtype).tiny)))


@_half_area.defjvp
def _(primals, tangents):
    (height,), (dot,) = primals, tangents
    slope = jnp.where(jnp.abs(height) < 1, _half_chord(jnp.clip(height, -1, 1)), 0)
    return _half_area(height), slope * dot


def arcs_in_strip(
    rim: Rim, low: Float[Array, "*shape"], high: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """The share of all arcs in the area of a strip, and in its first moment along x.

    The integrals of x and of x**2 / 2 along y, over the parts of the arcs between two heights.
    From the circle's lowest point up its right side and down its left one they have closed
    forms, of which the difference between an arc's ends is taken.
    """
    x = rim.center[0]
    low, high = (jnp.clip(each - rim.center[1], -1, 1) for each in (low, high))
    area_low, area_high = _half_area(low), _half_area(high)

    def at(end: Array, area: Array) -> tuple[Array, Array]:
        """The height in the strip, and the area up to there, from the lowest point on."""
        height = end[:, 1]
        above, below = height >= high[None], height <= low[None]
        area = jnp.where(above, area_high[None], jnp.where(below, area_low[None], area))
        height = jnp.where(above, high[None], jnp.where(below, low[None], height))
        return height, jnp.where(end[:, 0] >= 0, area, 2 * area_high[None] - area)

    start, area_start = at(rim.start, rim.start_area)
    end, area_end = at(rim.end, rim.end_area)
    whole = 2 * (area_high - area_low)
    rise = jnp.sum(end - start, axis=0)
    area = jnp.sum(area_end - area_start + rim.turns * whole[None], axis=0)
    cubic = jnp.sum((end - end**3 / 3) - (start - start**3 / 3), axis=0)
    return x * rise + area, x * x * rise / 2 + x * area + cubic / 2
