"""Discs painted by spans, block by block, and the exact adjoint of that.

In a row of pixels a disc is a span. Only its two ends are written, as steps; a running sum
along the row then fills all spans at once. The cost is pixels times rows, not pixels times
area.

An end that cuts a pixel at the fraction f adds `(1 - f)` of the step there and `f` in the next
pixel. With A the sum of all steps at the pixels that are cut, and B that of f times the step,
the image is `running_sum(A) - B`: one place to write for both. The adjoint reads each step
where it is written: that of A as the sum of the cotangents from there to the end of the row,
that of B as the cotangent itself.

A disc may have a tilt: its weight at an offset is then `1 + tilt . offset`. Each row is
weighted by the factor for its y. Along x a span has one weight; instead it is moved by
`tilt_x * half_width**2 / 3`, which keeps its sum and gives it the right centre of mass.

A running sum keeps the rounding errors of the values that it has passed. Discs that are much
brighter than the sum in a pixel must therefore not go through it. They are painted pixel by
pixel ("tap by tap") instead: here, if `Places.tap` says so, or by another program.

Discs are painted a block at a time, so that the block's steps stay in the cache. A running sum
begins at the margin of the block, so that what it rounds stays near its source.

Known limit: XLA runs a scatter on one core.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import fori_loop
from jaxfx._numerics import clip01
from jaxfx._xla import stored, sum_planes
from jaxfx.dof.kernels._taps import inside
from jaxfx.dof.sprites import POINT_RADIUS, segment_integral


# Ratio of a disc's value to the usual sum in a pixel from which on it is too bright for a
# running sum: in float32 it would leave 1e-6 of that sum along its row. With a larger ratio
# streaks show beside lights; with a smaller one more discs are painted slowly.
_HIGHLIGHT = 16.0
# Directions whose tangents are painted at once. More share more and take more memory: the steps
# of a block take 1 + DIRECTIONS times those of its discs. A wrong value costs time only.
DIRECTIONS = 4


class Discs(NamedTuple):
    """Some discs of a block, or their tangents, or their cotangents.

    Tangents have one more axis, that of directions, after the axis of discs.

    - `value`: what a pixel gets that the disc covers.
    - `radius`: pixels; 0 is no disc.
    - `tilt`: along x and y, 1 / pixels; None if no disc has one.
    """

    value: Float[Array, "disc value"]
    radius: Float[Array, " disc"]
    tilt: tuple[Float[Array, " disc"], Float[Array, " disc"]] | None = None


class Places(NamedTuple):
    """Where the discs lie in the window of their block.

    - `row`: row of pixels of the disc's centre.
    - `x`: place of the centre along the row, pixels.
    - `tap`: for discs that are painted tap by tap, the offset from the centre of the column
      that is painted, so that a disc comes once per column. None for spans.
    """

    row: Int[Array, " disc"]
    x: Float[Array, " disc"]
    tap: Int[Array, " disc"] | None = None


class Blocks:
    """An image of discs divided into blocks, and the windows into which they are painted.

    The window of a block is the block with the margin that its discs can reach. One more row
    below it takes writes that are to be discarded.

    - `size`: height and width of the image; `beyond`: as many pixels on each side of it lie
      beyond the frame that is painted.
    - `margin`: of a window, above and below, left and right, pixels.
    - `counts`: number of blocks down and across; `block`: height and width of one, pixels.
    - `rows`, `columns`: height and width of a window.
    """

    def __init__(
        self,
        size: tuple[int, ...],
        block: tuple[int, int],
        margin: tuple[int, int],
        beyond: int = 0,
    ):
        """`block` is about how high and wide a block is to be."""
        self.size, self.margin, self.beyond = size, margin, beyond
        self.counts = max(1, round(size[0] / block[0])), max(1, round(size[1] / block[1]))
        self.block = -(-size[0] // self.counts[0]), -(-size[1] // self.counts[1])
        self.rows, self.columns = (self.block[k] + 2 * margin[k] for k in (0, 1))

    def whole(
        self, planes: Float[Array, "... height width"], fill: float = 0.0
    ) -> Float[Array, "... rows columns"]:
        """The planes, filled up to whole blocks."""
        sides = [(0, self.counts[k] * self.block[k] - self.size[k]) for k in (0, 1)]
        margins = [(0, 0)] * (planes.ndim - 2) + sides
        return jnp.pad(planes, margins, constant_values=fill)

    def cut(
        self, planes: Float[Array, "plane rows columns"], block: Int[Array, ""]
    ) -> Float[Array, "disc plane"]:
        """A block of `whole` planes, one row per disc."""
        planes = jax.lax.dynamic_slice(planes, self._corner(block), (len(planes), *self.block))
        return planes.reshape(len(planes), -1).T

    def added(
        self,
        planes: Float[Array, "plane rows columns"],
        block: Int[Array, ""],
        discs: Float[Array, "disc plane"],
    ) -> Float[Array, "plane rows columns"]:
        """`whole` planes after something is added to the discs of a block."""
        return _added(planes, self._corner(block), discs.T.reshape(-1, *self.block))

    def listed(
        self, planes: Float[Array, "image plane height width"], fill: float = 0.0
    ) -> Float[Array, "block disc plane"]:
        """The planes of one or several images, one row per disc. `fill` fills up the blocks."""
        (down, across), (tall, wide) = self.counts, self.block
        planes = self.whole(planes, fill)
        images, count, *_ = planes.shape
        planes = planes.reshape(images, count, down, tall, across, wide)
        return planes.transpose(0, 2, 4, 3, 5, 1).reshape(-1, tall * wide, count)

    def planes(
        self, discs: Float[Array, "block disc plane"]
    ) -> Float[Array, "image plane height width"]:
        """The planes that `listed` made `discs` of."""
        (down, across), (tall, wide) = self.counts, self.block
        planes = discs.reshape(-1, down, across, tall, wide, discs.shape[-1])
        planes = planes.transpose(0, 5, 1, 3, 2, 4)
        planes = planes.reshape(*planes.shape[:2], down * tall, across * wide)
        return planes[..., : self.size[0], : self.size[1]]

    def are_held(self, radius: Float[Array, "height width"]) -> Bool[Array, " block"]:
        """Mask of the blocks that hold discs."""
        (down, across), (tall, wide) = self.counts, self.block
        blocks = self.whole(radius).reshape(down, tall, across, wide)
        return (blocks.max(axis=(1, 3)) > 0).reshape(-1)

    def places(
        self,
        dtype: DTypeLike,
        ids: Int[Array, " disc"] | None = None,
        tap: Int[Array, " disc"] | None = None,
    ) -> Places:
        """Where discs lie, by their numbers in a block; without these, all of a block."""
        ids = jnp.arange(math.prod(self.block)) if ids is None else ids
        row, column = ids // self.block[1], ids % self.block[1]
        return Places(row + self.margin[0], (column + self.margin[1]).astype(dtype) + 0.5, tap)

    def paint(
        self,
        is_held: Bool[Array, " block"],
        write: Callable[[Int[Array, ""], Array], Array],
        shape: tuple[int, int],
        dtype: DTypeLike,
    ) -> Float[Array, "stack_times_value height width"]:
        """Images of the spans whose steps `write(block, steps)` adds, block by block.

        `is_held` is the mask of the blocks that hold discs; only these are visited. `shape` is
        the number of stacks of values (values, tangents) and of values per stack.
        """
        stacks, values = shape

        def paint_block(block, canvas):
            steps = jnp.zeros(((self.rows + 1) * self.columns, stacks * 2 * values), dtype)
            steps = write(block, steps)
            painted = _painted(steps.reshape(self.rows + 1, self.columns, -1)[:-1])
            return _added(canvas, self._corner(block), painted)

        canvas = jnp.zeros((stacks * values, *self._canvas_size()), dtype)
        canvas = self._each(is_held, paint_block, canvas)
        (top, left), beyond = self.margin, self.beyond
        height, width = (n - 2 * beyond for n in self.size)
        return canvas[:, top + beyond :, left + beyond :][:, :height, :width]

    def read_back(
        self,
        is_held: Bool[Array, " block"],
        read: Callable[[Int[Array, ""], Array, Any], Any],
        bar: Float[Array, "value height width"],
        bars: Any,
        weight: Float[Array, "height width"] | None = None,
    ) -> Any:
        """The adjoint of `paint`: fold `read(block, steps, bars)` over the blocks.

        `bar` is the cotangent of the frame, or of that times `weight`. `steps` is then that of
        a block's steps.
        """
        sides = [
            (margin + self.beyond, total - margin - self.beyond - n)
            for margin, total, n in zip(
                self.margin, self._canvas_size(), bar.shape[1:], strict=True
            )
        ]
        # Each by itself: calls with several weights share the canvas of `bar`.
        factors = [bar] if weight is None else [bar, weight[None]]
        canvases = [jnp.pad(x, [(0, 0), *sides]) for x in factors]

        def window(canvas, block):
            size = len(canvas), self.rows, self.columns
            return jax.lax.dynamic_slice(canvas, self._corner(block), size)

        def read_block(block, bars):
            here = ft.reduce(jnp.multiply, [window(canvas, block) for canvas in canvases])
            steps = jnp.pad(_cotangents_of_steps(here), ((0, 1), (0, 0), (0, 0)))
            return read(block, steps.reshape(-1, 2 * len(bar)), bars)

        return self._each(is_held, read_block, bars)

    def _each(self, is_held: Bool[Array, " block"], visit: Callable, carry: Any) -> Any:
        """Fold `visit(block, carry)` over the blocks that hold discs."""
        order = jnp.argsort(~is_held)
        return fori_loop(0, is_held.sum(), lambda n, carry: visit(order[n], carry), carry)

    def _canvas_size(self) -> tuple[int, int]:
        """Height and width of all blocks with the margin of the outer ones."""
        down, across = (self.counts[k] * self.block[k] + 2 * self.margin[k] for k in (0, 1))
        return down, across

    def _corner(self, block: Int[Array, ""]) -> tuple[Any, ...]:
        """Start of a block's window in the canvas, the same for all images."""
        (down, across), (tall, wide) = self.counts, self.block
        block = block % (down * across)
        return 0, block // across * tall, block % across * wide


def write(
    blocks: Blocks,
    places: Places,
    discs: Discs,
    steps: Float[Array, "cell step"],
    dots: Discs | None = None,
    *,
    tangents_only: bool = False,
) -> Float[Array, "cell step"]:
    """Add the discs of a block to its steps; given tangents `dots`, also their tangents.

    A cell has the steps A of all values, then the steps B. The values are those of the discs,
    and then those of their tangents, direction by direction; with `tangents_only` these alone.
    """
    # Planes of discs: loops over the few values of a disc are slow.
    value = discs.value.T[None]
    values, radius_dots, tilt_dots = value, None, None
    if dots is not None:
        # The discs themselves are a first direction, without motion.
        still = [] if tangents_only else [jnp.zeros_like(discs.radius)[None]]
        values = jnp.moveaxis(dots.value, 0, -1)
        values = values if tangents_only else jnp.concatenate([value, values])
        motion = lambda dot: jnp.concatenate([*still, dot.T])
        radius_dots = motion(dots.radius)
        tilt_dots = None if dots.tilt is None else [motion(dot) for dot in dots.tilt]

    def planes_of(row, end):
        """The steps of an end in a row: A and then B, each of all values, as planes."""
        weight = jnp.full_like(end.cut, -end.side)
        if discs.tilt is not None:
            weight = weight * (1 + row * discs.tilt[1])
        whole = weight[None, None] * values
        if tilt_dots is not None:
            whole = whole + (-end.side * row * tilt_dots[1])[:, None] * value
        part = end.cut[None, None] * whole
        if radius_dots is not None:
            moved = end.by_radius[None] * radius_dots
            if tilt_dots is not None:
                moved = moved + end.by_tilt[None] * tilt_dots[0]
            part = part + (weight[None] * moved)[:, None] * value
        return jnp.concatenate([end.whole * whole, part]).reshape(-1, len(weight))

    def visit(steps, row, cells, end):
        both = lambda: [planes_of(y, end) for y in (row, -row)]
        # Many planes in memory: XLA would transpose them and all that leads to them as one.
        planes = both() if dots is None else stored(row >= 0, both)
        for cell, written in zip(cells, planes, strict=True):
            steps = _add(steps, cell, written.T)
        return steps

    return _each_end(blocks, places, discs, visit, steps, slopes=dots is not None)


def read(
    blocks: Blocks, places: Places, discs: Discs, steps: Float[Array, "cell step"]
) -> Discs:
    """The adjoint of `write`: the cotangents of discs at those of their block's steps."""
    count = discs.value.shape[1]
    value, tilt = discs.value, discs.tilt

    def visit(bars, row, cells, end):
        below, above = (_read(steps, cell) for cell in cells)
        # The two rows have the weights 1 + tilt_y * row and 1 - tilt_y * row.
        both, tilt_bar = below + above, None
        if tilt is not None:
            leaning = row * (below - above)
            both = both + tilt[1][:, None] * leaning
            tilt_y_bar = bars.tilt[1] + sum_planes(value * end.adjoint_of(leaning), 1)
            tilt_bar = bars.tilt[0], tilt_y_bar
        # The cotangent of the end's x: there the pixel gains or loses the disc's value.
        moving = end.side * sum_planes(value * both[:, count:], 1)
        if tilt_bar is not None:
            tilt_bar = tilt_bar[0] + end.by_tilt * moving, tilt_bar[1]
        value_bar = bars.value + end.adjoint_of(both)
        return Discs(value_bar, bars.radius + end.by_radius * moving, tilt_bar)

    nothing = jax.tree.map(jnp.zeros_like, discs)
    return _each_end(blocks, places, discs, visit, nothing, slopes=True)


def filled(steps: Float[Array, "... step"], axis: int) -> Float[Array, "... value"]:
    """The spans whose steps these are: `running_sum(A) - B`, along the axis of columns.

    The last axis holds the steps A and then B, of each value.
    """
    whole, part = jnp.split(steps, 2, axis=-1)
    return jax.lax.cumsum(whole, axis=axis) - part


def _painted(
    steps: Float[Array, "row column step"],
) -> Float[Array, "value row column"]:
    """`filled` along the rows of a window, as planes.

    Column by column: XLA:CPU takes two to three times as long for a cumulative sum.
    """
    rows, columns, count = steps.shape
    values = count // 2

    def add(index, state):
        sums, planes = state
        column = jax.lax.dynamic_index_in_dim(steps, index, 1, keepdims=False)
        sums = sums + column[:, :values]
        here = (sums - column[:, values:]).T
        return sums, jax.lax.dynamic_update_index_in_dim(planes, here, index, 2)

    nothing = jnp.zeros((rows, values), steps.dtype)
    planes = jnp.zeros((values, rows, columns), steps.dtype)
    return fori_loop(0, columns, add, (nothing, planes))[1]


def _cotangents_of_steps(
    bar: Float[Array, "value row column"],
) -> Float[Array, "row column step"]:
    """The transpose of `_painted`, but for the sign of the steps B."""
    values, rows, columns = bar.shape

    def add(index, state):
        sums, steps = state
        column = columns - 1 - index
        here = jax.lax.dynamic_index_in_dim(bar, column, 2, keepdims=False).T
        sums = sums + here
        both = jnp.concatenate([sums, here], axis=1)
        return sums, jax.lax.dynamic_update_index_in_dim(steps, both, column, 1)

    nothing = jnp.zeros((rows, values), bar.dtype)
    steps = jnp.zeros((rows, columns, 2 * values), bar.dtype)
    return fori_loop(0, columns, add, (nothing, steps))[1]


def too_bright(
    value: Float[Array, "value height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Mask of the discs that must not go through a running sum.

    Their value is far above what a pixel usually sums to: the mean over all discs, without the
    excess of the brightest.
    """
    size = jnp.abs(value).max(axis=0)
    total = jnp.pi * radius * radius * size
    usual = jnp.mean(total)
    for _ in range(3):
        usual = jnp.mean(jnp.minimum(total, usual))
    return size > _HIGHLIGHT * usual


class _End(NamedTuple):
    """The starts (`side` -1) or the ends (1) of the spans of some discs, in one row of each.

    - `column`: column of the window in which the end lies.
    - `cut`: where in that pixel the end lies, 0 at its left border to 1 at its right.
    - `by_tilt`, `by_radius`: derivatives of the x of the end with respect to the tilt along x
      and to the radius; None where no derivative is asked for.
    - `whole`: 1 for spans. 0 for taps (single pixels painted without the running sum): `cut` is
      then the coverage of the pixel, and `by_tilt` and `by_radius` are its derivatives.
    """

    side: int
    whole: int
    column: Int[Array, " disc"]
    cut: Float[Array, " disc"]
    by_tilt: Array
    by_radius: Array | None

    def adjoint_of(self, steps: Float[Array, "disc step"]) -> Float[Array, "disc value"]:
        """The cotangent of a disc's value at those of its steps."""
        ahead, here = jnp.split(steps, 2, axis=1)
        return -self.side * (self.whole * ahead - self.cut[:, None] * here)


def _each_end(
    blocks: Blocks, places: Places, discs: Discs, visit: Callable, carry: Any, *, slopes: bool
) -> Any:
    """Fold `visit(carry, row, cells, end)` over the ends of the spans, or over the taps.

    `row` is the distance of two rows from the middle one, `cells` are the flat indices of the
    window's pixels that the end lies in, in the row below and in the one above.
    """
    radius, tilt_x = discs.radius, None if discs.tilt is None else discs.tilt[0]

    def add_row(index, state):
        carry, lower = state
        row = index.astype(radius.dtype)
        upper = segment_integral(radius, row + 0.5, slopes)
        half_width, *slope = (a - b for a, b in zip(upper, lower, strict=True))
        # The middle row is its own mirror image: the second write is discarded.
        above = jnp.where(index > 0, places.row - index, blocks.rows)
        for end in _ends(places, tilt_x, half_width, slope[0] if slopes else None):
            cells = [y * blocks.columns + end.column for y in (places.row + index, above)]
            carry = visit(carry, row, cells, end)
        return carry, upper

    # The integral up to -1/2, the lower border of the middle row: it is odd in the height.
    lower = [-z for z in segment_integral(radius, jnp.asarray(0.5, radius.dtype), slopes)]
    rows = jnp.ceil(radius.max() - POINT_RADIUS).astype(int) + 1
    return fori_loop(0, rows, add_row, (carry, lower))[0]


def _ends(
    places: Places,
    tilt_x: Float[Array, " disc"] | None,
    half_width: Float[Array, " disc"],
    slope: Float[Array, " disc"] | None,
) -> list[_End]:
    """The start and the end of each disc's span in a row; or, tap by tap, one of its pixels.

    `half_width` is that of the span, in pixels; `slope` its derivative with respect to the
    radius, None where no derivative is asked for.
    """
    by_tilt, shift, shift_slope = half_width * half_width / 3, 0, 0
    if tilt_x is not None:
        shift, shift_slope = tilt_x * by_tilt, tilt_x * half_width * (2 / 3)
    if places.tap is not None:
        middle = shift + 0.5 - places.tap.astype(half_width.dtype)
        start, end = middle - half_width, middle + half_width
        cover = clip01(end) - clip01(start)
        moving, growing = inside(end) - inside(start), inside(end) + inside(start)
        by_radius = None if slope is None else (growing + moving * shift_slope) * slope
        column = places.x.astype(int) + places.tap
        return [_End(1, 0, column, cover, moving * by_tilt, by_radius)]
    ends = []
    for side in (-1, 1):
        x = places.x + shift + side * half_width
        column = jnp.floor(x)
        by_radius = None if slope is None else (side + shift_slope) * slope
        ends.append(_End(side, 1, column.astype(int), x - column, by_tilt, by_radius))
    return ends


def _added(
    planes: Float[Array, "plane rows columns"],
    corner: tuple[Any, ...],
    part: Float[Array, "plane tall wide"],
) -> Float[Array, "plane rows columns"]:
    """The planes after `part` is added to them from `corner` on."""
    there = jax.lax.dynamic_slice(planes, corner, part.shape)
    return jax.lax.dynamic_update_slice(planes, there + part, corner)


def _add(
    steps: Float[Array, "cell step"], cell: Int[Array, " disc"], step: Float[Array, "disc step"]
) -> Float[Array, "cell step"]:
    """Steps after one more is added to each of the cells, all of which exist."""
    dimensions = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1,),
        inserted_window_dims=(0,),
        scatter_dims_to_operand_dims=(0,),
    )
    mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.scatter_add(steps, cell[:, None], step, dimensions, mode=mode)


def _read(
    steps: Float[Array, "cell step"], cell: Int[Array, " disc"]
) -> Float[Array, "disc step"]:
    """The steps of the cells, all of which exist."""
    return steps.at[cell].get(mode="promise_in_bounds")
