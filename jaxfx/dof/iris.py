"""The iris of a lens: the shape that a point out of focus takes.

`scatter`, `layered` and `accumulate` take it. Sprites are spans, one per row of pixels: a shape
is known by its chords, where a row of pixels cuts it and how much of it lies there.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaxfx._checks import (
    WholeNumber,
    check,
    check_fields,
    is_concrete,
    parameter,
    whole_number,
    with_numbers,
)
from jaxfx.dof.rim import Rim, arcs_in_strip, center_of, field_of, quarters, rimmed
from jaxfx.dof.sprites import row_half_width


# The fewest sides that a shape has.
_FEWEST = 3


@final
class Iris(eqx.Module):
    """The shape of a lens' opening: a disc, or blades, straight or rounded, and squeezed.

    A point behind the focus is spread over this shape, one before it over the shape turned by
    half a turn. All shapes lie inside the disc: the circle of confusion stays the diameter of
    the fully open, round lens, and blades cut a part of it away, as they do in Blender. Off the
    middle of the image the lens' rim may cut it (cat's eyes), and its light need not be even
    (soap bubbles, creamy blur).

    **Arguments:**

    - `blades`: static; how many sides the opening has, from 3 on; 0 is the disc.
    - `rotation`: radians, from x (right) towards y (down). At 0 a corner points to the right.
    - `roundness`: a ratio, 0 to 1: the curvature of the blades over that of the disc. At 0 they
      are straight, at 1 they make the disc. Of no effect without blades.
    - `squeeze`: a ratio, above 0 and up to 1: the opening's width over that without squeeze,
      along x, whatever the rotation. An anamorphic lens of factor 2 has 0.5.
    - `vignetting`: a ratio, 0 to 1, of optical vignetting: how far the lens' rim, a disc of the
      lens' radius, has moved at the image's corner, in radii; in proportion nearer the middle.
      It moves against the field: below the middle of the image upwards. What lies in the
      opening and in the rim is left; both are squeezed. 0 is none.
    - `profile`: a ratio, -1 to 1: from a soap bubble, dark within and bright at the rim, to a
      creamy blur, bright within; 0 is even. Its light per area is
      `1 + profile * (1 - 2 r**2)` times that of the even one, with r from 0 in the middle to 1
      at the outline.
    - `rings`: static; how many steps of equal area stand for that profile, each of the shape of
      the opening. The time grows with it; without a profile it is of no effect.

    **Raises:** `ValueError` for 1 or 2 blades, no rings, or a number out of its range. Traced
    values can't be looked at: there a ratio out of range makes every pixel NaN.

    **Gradient:** exact with respect to all five numbers; `roundness`, `squeeze` and
    `vignetting` at the ends of their ranges have that of the side within.

    A rim takes no light: each pixel's is spread over what is left of its shape, and an even
    picture stays even. A real lens' picture gets darker towards its corners;
    `Iris.open_share` is how much.

    **Example:**

    >>> from jaxfx.dof import Iris
    >>> print(f"{Iris(blades=6).area():.3f} of {Iris().area():.3f}")
    2.598 of 3.142

    Source: the chord and the area of a circular segment are textbook geometry; blades as arcs
    of equal curvature between corners on the disc are our own model.
    Cutting the opening by a disc that moves across the field is the usual model of optical
    vignetting; the profile, and its steps, are our own.
    """

    SHAPES: ClassVar = dict.fromkeys(
        ("rotation", "roundness", "squeeze", "vignetting", "profile"), ()
    )

    blades: int = eqx.field(static=True)
    rotation: Float[Array, ""]
    roundness: Float[Array, ""] | None
    squeeze: Float[Array, ""]
    vignetting: Float[Array, ""] | None
    profile: Float[Array, ""] | None
    rings: int = eqx.field(static=True)

    def __repr__(self) -> str:
        return with_numbers(self)

    def __init__(
        self,
        blades: WholeNumber = 0,
        rotation: Any = 0.0,
        roundness: Any = 0.0,
        squeeze: Any = 1.0,
        vignetting: Any = 0.0,
        profile: Any = 0.0,
        rings: WholeNumber = 8,
    ):
        is_count = lambda n: n == 0 or n >= _FEWEST
        self.blades = whole_number("Iris(blades)", blades, is_count, "0, or an integer from 3")
        self.rotation = parameter("Iris(rotation)", rotation)
        self.roundness = bend = parameter("Iris(roundness)", roundness)
        self.squeeze = parameter("Iris(squeeze)", squeeze)
        check("Iris(rotation)", self.rotation, np.isfinite, "finite")
        check("Iris(roundness)", bend, lambda v: (v >= 0) & (v <= 1), "from 0 to 1")
        is_ratio = lambda v: (v > 0) & (v <= 1)
        check("Iris(squeeze)", self.squeeze, is_ratio, "above 0 and at most 1")
        self.vignetting = moved = parameter("Iris(vignetting)", vignetting)
        self.profile = parameter("Iris(profile)", profile)
        self.rings = whole_number("Iris(rings)", rings)
        check("Iris(vignetting)", moved, lambda v: (v >= 0) & (v <= 1), "from 0 to 1")
        check("Iris(profile)", self.profile, lambda v: abs(v) <= 1, "from -1 to 1")

    def open_share(
        self, height: WholeNumber, width: WholeNumber
    ) -> Float[Array, "rows columns"]:
        """How much of the opening each pixel of an image sees past the rim.

        A picture times this gets darker towards its corners, as by optical vignetting.

        **Arguments:** `height`, `width`: static; of the image, in pixels.

        **Returns:** rows columns, a ratio: 1 on the axis, and everywhere without `vignetting`.

        **Raises:** `ValueError` where the size is none.

        **Gradient:** exact.

        **Example:**

        >>> from jaxfx.dof import Iris
        >>> print(f"{Iris(vignetting=1.0).open_share(201, 201)[0, 0]:.2f}")
        0.39
        """
        size = (
            whole_number("open_share(height)", height),
            whole_number("open_share(width)", width),
        )
        dtype = self.squeeze.dtype
        if self.vignetting is None:
            return jnp.ones(size, dtype)
        return areas(outline(self, dtype, size)) / self.area()

    def area(self) -> Float[Array, ""]:
        """The area of the opening, where the disc's radius is 1, as one on the axis sees it.

        **Returns:** a scalar, without unit: pi for the disc.

        **Gradient:** exact; zero in `rotation`.
        """
        squeeze = self._valid_squeeze()
        if self.blades == 0:
            return math.pi * squeeze
        half = math.sin(math.pi / self.blades)
        triangle = math.sin(2 * math.pi / self.blades) / 2
        if self.roundness is None:
            return self.blades * triangle * squeeze
        square = jnp.asarray(4 * half * half, self.roundness.dtype)
        segment, _ = _segment(square, self.roundness, half)
        return self.blades * (triangle + segment).astype(squeeze.dtype) * squeeze

    def _valid_squeeze(self) -> Float[Array, ""]:
        """NaN where it or another number is out of its range."""
        is_valid = (self.squeeze > 0) & (self.squeeze <= 1)
        for ratio, least in ((self.roundness, 0), (self.vignetting, 0), (self.profile, -1)):
            if ratio is not None:
                is_valid &= (ratio >= least) & (ratio <= 1)
        return jnp.where(is_valid, self.squeeze, jnp.nan)


class Points(NamedTuple):
    """Points of a lens and what they let through.

    - `unit`: x and y on the unit disc, turned with the iris and not squeezed.
    - `squeezed`: the same squeezed: the derivative is exact in `rotation` and `squeeze`.
    - `held`: for each ring from the middle on whether it holds the point; one for even light.
    """

    unit: Float[Array, "count 2"]
    squeezed: Float[Array, "count 2"]
    held: Bool[np.ndarray, "count ring"]


def points_of(iris: Iris, unit: Float[np.ndarray, "count 2"]) -> Points:
    """Points of the unit disc, by an iris before it is turned and squeezed.

    `roundness` and `vignetting` must be concrete.
    """
    for name in ("roundness", "vignetting"):
        if not is_concrete(getattr(iris, name)):
            raise ValueError(
                f"`accumulate(iris.{name})` must be concrete, which says what points the iris "
                "holds, got a traced number."
            )
    held = np.stack([_are_held(iris, unit / scale) for scale in ring_scales(iris)], axis=1)
    sine, cosine = jnp.sin(iris.rotation), jnp.cos(iris.rotation)
    x, y = jnp.asarray(unit, iris.rotation.dtype).T
    turned = [cosine * x - sine * y, sine * x + cosine * y]
    squeezed = [iris.squeeze.astype(x.dtype) * turned[0], turned[1]]
    return Points(jnp.stack(turned, axis=1), jnp.stack(squeezed, axis=1), held)


def _are_held(iris: Iris, unit: Float[np.ndarray, "count 2"]) -> Bool[np.ndarray, " count"]:
    bend = 0.0 if iris.roundness is None else float(iris.roundness)
    held = (unit**2).sum(axis=1) <= 1
    half = math.sin(math.pi / max(iris.blades, 1))
    for k in range(iris.blades):
        angle = (2 * k + 1) * math.pi / iris.blades
        normal = np.array([math.cos(angle), math.sin(angle)])
        away = unit - math.cos(math.pi / iris.blades) * normal
        bulge = bend / 2 * ((away**2).sum(axis=1) - half**2)
        held &= bulge + math.sqrt(1 - (bend * half) ** 2) * (away @ normal) <= 0
    return held


@ft.partial(jax.jit, static_argnames=("height", "width", "dtype"))
def let_through(
    iris: Iris,
    unit: Float[Array, "2"],
    held: Bool[Array, " ring"],
    height: int,
    width: int,
    dtype: Any,
) -> Float[Array, "height width"]:
    """How much light a point of `Points` lets through to each pixel; 1 for even light."""
    light = jnp.zeros((height, width), dtype)
    rings = rings_of(iris)
    rings = jnp.ones(1, dtype) if rings is None else rings.astype(dtype)
    for ring, scale in enumerate(ring_scales(iris)):
        passes = held[ring]
        if iris.vignetting is not None:
            center = center_of(iris.vignetting.astype(dtype), field_of(height, width, dtype))
            point = unit.astype(dtype)[:, None, None] / scale
            passes &= jnp.sum((point - center) ** 2, axis=0) <= 1
        light += jnp.where(passes, rings[ring], 0)
    return light


def ring_scales(iris: Iris) -> tuple[float, ...]:
    """The outline of each ring over that of the opening."""
    count = 1 if iris.profile is None else iris.rings
    return tuple(math.sqrt((k + 1) / count) for k in range(count))


def check_iris(name: str, iris: Any) -> Iris:
    """The iris, without what is known to be 0; `ValueError` unless it is one.

    To a compiled program that is another type of argument: that of straight blades is quicker,
    and so is that of an opening that no rim cuts, or of even light.
    """
    if not isinstance(iris, Iris):
        raise ValueError(f"`{name}` must be an Iris, got {type(iris).__name__}.")
    parts = lambda iris: (iris.roundness, iris.vignetting, iris.profile)
    is_none = lambda x: x is None
    given = [iris.squeeze if part is None else part for part in parts(iris)]
    check_fields(name, eqx.tree_at(parts, iris, tuple(given), is_leaf=is_none))
    bend, moved, profile = (
        None if part is None or (is_concrete(part) and float(part) == 0) else part
        for part in parts(iris)
    )
    parted = bend if iris.blades else None, moved, profile
    return eqx.tree_at(parts, iris, parted, is_leaf=is_none)


class Pieces(NamedTuple):
    """Parts of an outline along which y does not turn, in radii of the disc.

    - `start`, `end`: x and y of both ends; per pixel, along the last axes, where a rim cuts.
    - `middle`, `normal`: of the chord of the arc of which this is a part: its midpoint, and the
      direction outwards.
    """

    start: Float[Array, "..."]
    end: Float[Array, "..."]
    middle: Float[Array, "*piece 2"]
    normal: Float[Array, "*piece 2"]


class Outline(NamedTuple):
    """The outline of an iris: a disc, or lines or arcs between corners on the disc.

    - `pieces`: all of it without its squeeze, anticlockwise where y points up; none for a disc.
      Each arc is two pieces, of which one is empty unless the arc holds its circle's highest or
      lowest point.
    - `half`: half of the length of each line or arc's chord.
    - `curvature`: that of each arc; none for lines.
    - `squeeze`: what x is finally multiplied by.
    - `rim`: the second disc, which has cut the pieces, per pixel; None where there is none.
    - `rings`: how much brighter each ring is than the next one outwards, the last one than
      nothing, where even light is 1; None for even light.
    """

    pieces: Pieces | None
    half: float
    curvature: Float[Array, ""] | None
    squeeze: Float[Array, ""]
    rim: Rim | None = None
    rings: Float[Array, " ring"] | None = None


def outline(iris: Iris, dtype: Any, size: tuple[int, ...] = (), margin: int = 0) -> Outline:
    """The pieces of an iris' outline, in `dtype`.

    Per pixel of an image of that `size`, height and width, if the iris has a `vignetting`. The
    image is wider by `margin` pixels on each side than what the lens takes.
    """
    iris = jax.tree.map(lambda x: x.astype(dtype), iris)
    whole = _uncut(iris, dtype)._replace(rings=rings_of(iris))
    if iris.vignetting is None:
        return whole
    height, width = size
    field = field_of(height, width, dtype, margin)
    center = center_of(iris.vignetting, field)
    if whole.pieces is None:
        corners, normals = quarters(dtype)
        middle = math.sqrt(0.5) * normals
        pieces = Pieces(corners, jnp.roll(corners, -1, axis=0), middle, normals)
        half, curvature = math.sqrt(0.5), jnp.ones((), dtype)
        square = jnp.sum(field * field, axis=0)
        is_aside = square > 0
        x = jnp.where(is_aside, 1 / jnp.sqrt(jnp.where(is_aside, square, 1)), 0)[None] * field
        toward = jnp.where(is_aside[None], -x, jnp.array([1, 0], dtype)[:, None, None])
    else:
        pieces, half, curvature, toward = whole.pieces, whole.half, whole.curvature, None
        if curvature is not None:
            # Both halves of each arc after one another.
            order = np.arange(len(pieces.start)).reshape(2, -1).T.ravel()
            pieces = jax.tree.map(lambda x: x[order], pieces)
    pieces, second = rimmed(pieces, half, curvature, center, toward)
    return whole._replace(pieces=pieces, half=half, curvature=curvature, rim=second)


def rings_of(iris: Iris) -> Float[Array, " ring"] | None:
    """How much brighter each ring is than the next one outwards, the last one than nothing.

    Ring k of K lies between the outline times `sqrt((k - 1) / K)` and times `sqrt(k / K)`, and
    has the mean light of the profile there. None for even light.
    """
    if iris.profile is None:
        return None
    step = 2 * iris.profile / iris.rings
    inner = jnp.broadcast_to(step, (iris.rings - 1,))
    return jnp.append(inner, 1 - step * (iris.rings - 1) / 2)


def moved(outline: Outline, move: Callable[[Array], Array]) -> Outline:
    """The outline, `move` applied to all that it has per pixel, of which the last axes are."""
    if outline.rim is None or outline.pieces is None:
        return outline
    start, end, *rest = outline.pieces
    pieces = Pieces(move(start), move(end), *rest)
    return outline._replace(pieces=pieces, rim=jax.tree.map(move, outline.rim))


def areas(outline: Outline) -> Float[Array, "height width"]:
    """The area of what the rim leaves of the opening where the disc's radius is 1."""
    assert outline.rim is not None
    high = jnp.full_like(outline.rim.center[0], 2)
    return outline.squeeze * _area_and_moment(outline, -high, high)[0]


class Cut(NamedTuple):
    """A row of pixels through sprites or, if they have rings, through what a ring bounds.

    - `row`: from a sprite's centre. `scale`, `weight`: of the ring's outline over the sprite's,
      and its share in `Outline.rings`; None without rings.
    """

    row: Num[Array, "*cut"]
    scale: Float[Array, "*cut"] | None
    weight: Float[Array, "*cut"] | None


def cuts(outline: Outline, reach: int) -> Cut:
    """The rows of pixels of every ring, along the first axis, from the inner ring outwards.

    `reach`: rows above and below its centre that the largest sprite covers, in pixels.
    """
    if outline.rings is None:
        return Cut(jnp.arange(-reach, reach + 1), None, None)
    count = len(outline.rings)
    scales = np.sqrt(np.arange(1, count + 1) / count)  # As `ring_scales`.
    far = [math.ceil(scale * (reach + 0.5) - 0.5) for scale in scales]
    rows = np.concatenate([np.arange(-n, n + 1) for n in far])
    ring = np.repeat(np.arange(count), [2 * n + 1 for n in far])
    weight = outline.rings[ring]
    return Cut(jnp.asarray(rows), jnp.asarray(scales[ring], weight.dtype), weight)


def span(
    outline: Outline,
    radius: Float[Array, "*shape"],
    side: Float[Array, "*shape"],
    cut: Cut,
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """`chord` of one of the `cuts`."""
    return chord(outline, radius if cut.scale is None else cut.scale * radius, side, cut.row)


def _uncut(iris: Iris, dtype: Any) -> Outline:
    """The outline as one on the axis sees it."""
    squeeze, sides, curvature = iris._valid_squeeze(), iris.blades, iris.roundness
    if sides == 0:
        return Outline(None, 1.0, None, squeeze)
    half, apothem = math.sin(math.pi / sides), math.cos(math.pi / sides)
    at = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    steps = jnp.arange(sides, dtype=dtype) * (2 * math.pi / sides)
    first = at(iris.rotation + steps)
    last = jnp.roll(first, -1, axis=0)
    normal = at(iris.rotation + steps + math.pi / sides)
    middle = apothem * normal
    if curvature is None:
        return Outline(Pieces(first, last, middle, normal), half, None, squeeze)

    # The circle's highest or lowest point, if it is on the arc: there `_crossing` has one root.
    x, y = normal.T
    turns = (jnp.abs(x) < curvature * half) & (curvature > 0)
    bend = jnp.where(turns, curvature, 1)
    facing = _facing(curvature, half)
    rise = (bend * half**2 + facing**2 * x * x / bend) / (1 + facing * jnp.abs(y))
    extremum = middle + jnp.stack([-facing * x / bend, jnp.sign(y) * rise], axis=1)
    turn = jnp.where(turns[:, None], extremum, last)
    twice = lambda x: jnp.concatenate([x, x])
    starts, ends = jnp.concatenate([first, turn]), jnp.concatenate([turn, last])
    pieces = Pieces(starts, ends, twice(middle), twice(normal))
    return Outline(pieces, half, curvature, squeeze)


def _facing(curvature: Float[Array, ""], half: float) -> Float[Array, ""]:
    """The cosine of half the angle of an arc, by its curvature and half its chord."""
    return jnp.sqrt(1 - (curvature * half) ** 2)


def chord(
    outline: Outline,
    radius: Float[Array, "*shape"],
    side: Float[Array, "*shape"],
    row: Num[Array, ""] | int,
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Centre and half-width, in pixels, of the span that a sprite is in a row of pixels.

    The span has the area of the part of the sprite between `row - 1/2` and `row + 1/2`, and its
    mean x. Twice the half-widths of all rows add up to the sprite's area, exactly. `radius` is
    that of the disc, positive; `side` is 1 for a sprite as it is, -1 for one that is turned by
    half a turn.
    """
    if outline.pieces is None:
        return jnp.zeros_like(radius), outline.squeeze * row_half_width(radius, row)
    place = side * jnp.asarray(row, radius.dtype)
    low, high = (place - 0.5) / radius, (place + 0.5) / radius
    area, moment = _area_and_moment(outline, low, high)
    # Of a strip that is nothing beside the shape, the mean would be rounding.
    is_there = area > 16 * jnp.finfo(radius.dtype).eps
    area = jnp.where(is_there, area, 0)
    mean = jnp.where(is_there, moment / jnp.where(is_there, area, 1), 0)
    squeeze = outline.squeeze
    return side * radius * squeeze * mean, radius * radius * squeeze * area / 2


def _area_and_moment(
    outline: Outline, low: Float[Array, "*shape"], high: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Of the outline between two heights, without its squeeze; the moment is along x."""
    part = jax.vmap(lambda piece: _strip(outline, piece, low, high))
    area, moment = (jnp.sum(x, axis=0) for x in part(outline.pieces))
    if outline.rim is None:
        return area, moment
    area_of_arcs, moment_of_arcs = arcs_in_strip(outline.rim, low, high)
    return area + area_of_arcs, moment + moment_of_arcs


def _strip(
    outline: Outline, piece: Pieces, low: Float[Array, "*shape"], high: Float[Array, "*shape"]
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """The share of a piece in the area of a strip, and in its first moment along x.

    Of the part of the piece between the two heights, the integrals of x and of x**2 / 2 along
    y: those of its chord, and of the circular segment beyond the chord.
    """
    (x_start, y_start), (x_end, y_end) = piece.start, piece.end
    upward = y_end >= y_start
    bottom, top = jnp.minimum(y_start, y_end), jnp.maximum(y_start, y_end)
    x_bottom, x_top = (
        jnp.where(upward, *pair) for pair in ((x_start, x_end), (x_end, x_start))
    )
    if outline.curvature is None:
        is_steep = top > bottom
        run = jnp.where(is_steep, (x_top - x_bottom) / jnp.where(is_steep, top - bottom, 1), 0)
        crossing = lambda height: x_bottom + run * (height - bottom)
    else:
        crossing = ft.partial(_crossing, outline.curvature, outline.half, piece, upward)

    def cut(height):
        """x and y of the piece there, or of its nearer end."""
        inside = (height > bottom) & (height < top)
        x = crossing(jnp.where(inside, height, (bottom + top) / 2))
        x = jnp.where(inside, x, jnp.where(height >= top, x_top, x_bottom))
        return x, jnp.where(inside, height, jnp.where(height >= top, top, bottom))

    (x_low, y_low), (x_high, y_high) = cut(low), cut(high)
    rise = jnp.where(upward, 1, -1) * (y_high - y_low)
    middle = (x_low + x_high) / 2
    area = middle * rise
    moment = (x_low * x_low + x_low * x_high + x_high * x_high) * rise / 6
    if outline.curvature is None:
        return area, moment
    square = (x_high - x_low) ** 2 + (y_high - y_low) ** 2
    segment, lever = _segment(square, outline.curvature, outline.half)
    return area + segment, moment + segment * middle + lever * rise


def _crossing(
    curvature: Float[Array, ""],
    half: float,
    piece: Pieces,
    upward: Bool[Array, "*#shape"],
    height: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """x of a piece at a height between those of its ends.

    From the midpoint of its chord, the arc is where `curvature / 2 * (u**2 + v**2 - half**2) +
    facing * (u, v) . normal` is 0: solved for u in the form that has no cancellation.
    """
    facing = _facing(curvature, half)
    v = height - piece.middle[1]
    side = jnp.where(upward, 1, -1).astype(v.dtype)
    slope = side * facing * piece.normal[0]
    constant = curvature / 2 * (v * v - half * half) + facing * piece.normal[1] * v
    square = slope * slope - 2 * curvature * constant
    # The floor is nothing beside a radius, and keeps the root's derivatives finite.
    root = jnp.sqrt(jnp.maximum(square, jnp.finfo(v.dtype).eps))
    outer = slope > 0
    bend = jnp.where(outer, 1, jnp.where(curvature > 0, curvature, 1))
    u = jnp.where(
        outer, -2 * constant / jnp.where(outer, slope + root, 1), (root - slope) / bend
    )
    return piece.middle[0] + side * u


def _segment(
    square: Float[Array, "*shape"], curvature: Float[Array, ""], half: float
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Area between a chord, of that squared length, and its arc; and how far out it lies.

    The second is the area's first moment along the chord's normal, over the chord's length.
    `half` is half of the longest chord.
    """
    bent = curvature * curvature * square / 4  # The square of the sine of half the angle.
    is_single = square.dtype == jnp.float32
    area, lever = (
        ft.reduce(lambda sum_, coefficient: sum_ * bent + coefficient, reversed(polynomial))
        for polynomial in _segment_polynomials(half, 1e-8 if is_single else 1e-17)
    )
    there = square > 0
    length = jnp.sqrt(jnp.where(there, square, 1))
    cubic = jnp.where(there, square * length, 0)
    return curvature / 2 * cubic * area, square * lever


@ft.cache
def _segment_polynomials(half: float, error: float) -> tuple[tuple[float, ...], ...]:
    """Of an arc of curvature 1 and chord `2 s`: `(asin(s) - s sqrt(1 - s**2)) / (4 s**3)`, and
    `1 / 12` less half of that times `sqrt(1 - s**2)`; by powers of s**2, lowest first.

    For `s` up to `half`, by Chebyshev fits. The nearest branch point is at 1, which says how
    the error falls with the degree. `asin(s) - s sqrt(1 - s**2)` is the integral of
    `2 t**2 / sqrt(1 - t**2)`, whose series is summed at the nodes.
    """
    away = 2 / half**2 - 1
    degree = math.ceil(-math.log(error) / math.log(away + math.sqrt(away**2 - 1)))
    nodes = half**2 / 2 * (1 - np.cos(np.pi * (np.arange(4 * degree) + 0.5) / (4 * degree)))
    term, area = np.ones_like(nodes), np.zeros_like(nodes)
    for k in range(400):
        area += term / (2 * (2 * k + 3))
        term *= nodes * (2 * k + 1) / (2 * k + 2)
    lever = 1 / 12 - area * np.sqrt(1 - nodes) / 2
    fit = ft.partial(np.polynomial.Chebyshev.fit, nodes, deg=degree, domain=(0, half**2))
    plain = lambda series: series.convert(kind=np.polynomial.Polynomial)
    return tuple(tuple(map(float, plain(fit(y)).coef)) for y in (area, lever))
