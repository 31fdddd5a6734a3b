"""The iris of a lens: the shape that a point out of focus takes.

`scatter`, `layered` and `accumulate` take it. Sprites are spans, one per row of pixels: a shape
is known by its chords, where a row of pixels cuts it and how much of it lies there.
"""

import functools as ft
import math
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
from jaxfx.dof.sprites import row_half_width


# The fewest sides that a shape has.
_FEWEST = 3


@final
class Iris(eqx.Module):
    """The shape of a lens' opening: a disc, or blades, straight or rounded, and squeezed.

    A point behind the focus is spread over this shape, one before it over the shape turned by
    half a turn. All shapes lie inside the disc: the circle of confusion stays the diameter of
    the fully open, round lens, and blades cut a part of it away, as they do in Blender.

    **Arguments:**

    - `blades`: static; how many sides the opening has, from 3 on; 0 is the disc.
    - `rotation`: radians, from x (right) towards y (down). At 0 a corner points to the right.
    - `roundness`: a ratio, 0 to 1: the curvature of the blades over that of the disc. At 0 they
      are straight, at 1 they make the disc. Of no effect without blades.
    - `squeeze`: a ratio, above 0 and up to 1: the opening's width over that without squeeze,
      along x, whatever the rotation. An anamorphic lens of factor 2 has 0.5.

    **Raises:** `ValueError` for 1 or 2 blades, or a number out of its range. Traced values
    can't be looked at: there a ratio out of range makes every pixel NaN.

    **Gradient:** exact with respect to all three numbers; `roundness` and `squeeze` at the ends
    of their ranges have that of the side within.

    **Example:**

    >>> from jaxfx.dof import Iris
    >>> print(f"{Iris(blades=6).area():.3f} of {Iris().area():.3f}")
    2.598 of 3.142

    Source: the chord and the area of a circular segment are textbook geometry; blades as arcs
    of equal curvature between corners on the disc are our own model.
    """

    SHAPES: ClassVar = {"rotation": (), "roundness": (), "squeeze": ()}

    blades: int = eqx.field(static=True)
    rotation: Float[Array, ""]
    roundness: Float[Array, ""] | None
    squeeze: Float[Array, ""]

    def __repr__(self) -> str:
        return with_numbers(self)

    def __init__(
        self,
        blades: WholeNumber = 0,
        rotation: Any = 0.0,
        roundness: Any = 0.0,
        squeeze: Any = 1.0,
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

    def area(self) -> Float[Array, ""]:
        """The area of the opening, where the disc's radius is 1.

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
        """NaN where it or the roundness is out of its range."""
        is_valid = (self.squeeze > 0) & (self.squeeze <= 1)
        if self.roundness is not None:
            is_valid &= (self.roundness >= 0) & (self.roundness <= 1)
        return jnp.where(is_valid, self.squeeze, jnp.nan)


def points_of(
    iris: Iris, unit: Float[np.ndarray, "count 2"]
) -> tuple[Bool[np.ndarray, " count"], Float[Array, "count 2"]]:
    """Which points of the unit disc an iris holds before it is turned and squeezed.

    And all the points, turned and squeezed with it: the derivative is exact in `rotation` and
    `squeeze`. `roundness` must be concrete.
    """
    bend = 0.0 if iris.roundness is None else iris.roundness
    if not is_concrete(bend):
        raise ValueError(
            "`accumulate(iris.roundness)` must be concrete, which says what points the iris "
            "holds, got a traced number."
        )
    held = np.ones(len(unit), bool)
    half = math.sin(math.pi / max(iris.blades, 1))
    for k in range(iris.blades):
        curvature, angle = float(bend), (2 * k + 1) * math.pi / iris.blades
        normal = np.array([math.cos(angle), math.sin(angle)])
        away = unit - math.cos(math.pi / iris.blades) * normal
        bulge = curvature / 2 * ((away**2).sum(axis=1) - half**2)
        held &= bulge + math.sqrt(1 - (curvature * half) ** 2) * (away @ normal) <= 0
    sine, cosine = jnp.sin(iris.rotation), jnp.cos(iris.rotation)
    x, y = jnp.asarray(unit, iris.rotation.dtype).T
    turned = [iris.squeeze.astype(x.dtype) * (cosine * x - sine * y), sine * x + cosine * y]
    return held, jnp.stack(turned, axis=1)


def check_iris(name: str, iris: Any) -> Iris:
    """The iris, without a roundness that is known to be 0; `ValueError` unless it is one.

    To a compiled program that is another type of argument: that of straight blades is quicker.
    """
    if not isinstance(iris, Iris):
        raise ValueError(f"`{name}` must be an Iris, got {type(iris).__name__}.")
    bend = iris.roundness
    zero = eqx.tree_at(lambda x: x.roundness, iris, iris.squeeze, is_leaf=lambda x: x is None)
    check_fields(name, iris if bend is not None else zero)
    if iris.blades and not (bend is None or (is_concrete(bend) and float(bend) == 0)):
        return iris
    return eqx.tree_at(lambda iris: iris.roundness, iris, None)


class Pieces(NamedTuple):
    """Parts of an outline along which y does not turn, in radii of the disc.

    - `start`, `end`: x and y of both ends.
    - `middle`, `normal`: of the chord of the arc of which this is a part: its midpoint, and the
      direction outwards.
    """

    start: Float[Array, "*piece 2"]
    end: Float[Array, "*piece 2"]
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
    """

    pieces: Pieces | None
    half: float
    curvature: Float[Array, ""] | None
    squeeze: Float[Array, ""]


def outline(iris: Iris, dtype: Any) -> Outline:
    """The pieces of an iris' outline, in `dtype`."""
    iris = jax.tree.map(lambda x: x.astype(dtype), iris)
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
    part = jax.vmap(lambda piece: _strip(outline, piece, low, high))
    area, moment = (jnp.sum(x, axis=0) for x in part(outline.pieces))
    # Of a strip that is nothing beside the shape, the mean would be rounding.
    is_there = area > 16 * jnp.finfo(radius.dtype).eps
    area = jnp.where(is_there, area, 0)
    mean = jnp.where(is_there, moment / jnp.where(is_there, area, 1), 0)
    squeeze = outline.squeeze
    return side * radius * squeeze * mean, radius * radius * squeeze * area / 2


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
    upward: Bool[Array, ""],
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
