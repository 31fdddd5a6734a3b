"""Discs painted by spans: two steps of a running sum in every row.

Every disc adds its value where a span begins and takes it away where it ends; one running sum
along the rows then paints them all. The cost is pixels times rows, not pixels times area.

An end that cuts a pixel at the fraction f adds `(1 - f)` of the step there and `f` in the next
pixel. With A the sum of all steps at the pixels that are cut, and B that of f times the step,
the image is `running_sum(A) - B`: one place to write for both.

Discs are taken a block at a time, whose steps stay in the cache, out to the block's own largest
radius. A running sum begins again with each block, so that what it rounds stays near its
source.

What it does not do well: XLA writes scattered values on one core.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._loops import fori_loop
from jaxfx.dof.sprites import POINT_RADIUS, segment_integral


# Height and width of a block in pixels: enough discs to spread the overhead of a row; their
# steps fill a megabyte at a radius of 64. Larger blocks do not fit into a core's cache.
BLOCK = (32, 128)


def paint(
    reach: int,
    value: Float[Array, "value height width"],
    radius: Float[Array, "height width"],
    dot: tuple[Float[Array, "value height width"], Float[Array, "height width"]] | None = None,
) -> Float[Array, "value height width"]:
    """The sum of all discs, each its value times its coverage; a radius of 0 is no disc.

    Given `dot`, tangents of value and radius, the derivative of that along them.
    """
    blocks = _Blocks(reach, radius)
    values = len(value)
    planes = [*map(blocks.whole, (value, radius, *(dot or ())))]

    def paint_block(index, total):
        # A step of `u` adds [u, 0], and where the end cuts its pixel at f, f [0, u] as well.
        value, radius, *dots = (blocks.cut(x, index) for x in planes)
        there = (radius > 0).reshape(-1, 1)
        flat, *dots = (jnp.where(there, _flat(x), 0) for x in (value, *dots))
        zero = jnp.zeros_like(flat)
        moving = jnp.concatenate([zero, flat], axis=-1)
        step = dots[0] if dots else flat
        whole = jnp.concatenate([step, zero], axis=-1)
        part = jnp.concatenate([zero, step], axis=-1)

        def visit(steps, side, cut, cells, slope):
            step = whole + cut * part
            if dots:
                step = step + side * (slope[0].reshape(-1, 1) * dots[1]) * moving
            for cell in cells:
                steps = _add(steps, cell, -side * step)
            return steps

        cells = (blocks.rows + 1) * blocks.columns
        steps = jnp.zeros((cells, 2 * values), flat.dtype)
        steps = blocks.each_row(index, radius, visit, steps, slopes=bool(dots))
        steps = steps.reshape(blocks.rows + 1, blocks.columns, 2 * values)[:-1]
        painted = jax.lax.cumsum(steps[..., :values], axis=1) - steps[..., values:]
        return blocks.add(total, index, jnp.moveaxis(painted, -1, 0))

    total = blocks.each(paint_block, jnp.zeros_like(blocks.windowed(value)))
    return total[:, reach:, reach + 1 :][:, : blocks.height, : blocks.width]


def read_back(
    reach: int,
    value: Float[Array, "value height width"],
    radius: Float[Array, "height width"],
    bar: Float[Array, "value height width"],
    bars: tuple[Float[Array, "value height width"], Float[Array, "height width"]],
    weight: Float[Array, "height width"] | None = None,
) -> tuple[Float[Array, "value height width"], Float[Array, "height width"]]:
    """The adjoint of `paint`, times `weight`, at `bar`, added to `bars`, of value and radius.

    It reads each step where `paint` writes it: A as the sum of what comes later, B as it is.
    """
    blocks = _Blocks(reach, radius)
    values = len(value)
    planes = [*map(blocks.whole, (value, radius))]
    # The weight by itself: several calls share what their `bar` fills in memory.
    windows = [blocks.windowed(x) for x in ([bar] if weight is None else [bar, weight[None]])]

    def read_block(index, bars):
        value, radius = (blocks.cut(x, index) for x in planes)
        flat = _flat(value)
        seen = math.prod(blocks.cut(x, index, window=True) for x in windows)
        seen = jnp.moveaxis(seen, 0, -1)
        steps = jnp.concatenate([jax.lax.cumsum(seen, axis=1, reverse=True), seen], axis=-1)
        steps = jnp.pad(steps, ((0, 1), (0, 0), (0, 0))).reshape(-1, 2 * values)

        def visit(found, side, cut, cells, slope):
            value_bar, radius_bar = found
            step = _read(steps, cells[0]) + _read(steps, cells[1])
            ahead, here = step[:, :values], step[:, values:]
            value_bar = value_bar - side * (ahead - cut * here)
            return value_bar, radius_bar + slope[0].reshape(-1) * (flat * here).sum(axis=-1)

        nothing = jnp.zeros_like(flat), jnp.zeros_like(flat[:, 0])
        found = blocks.each_row(index, radius, visit, nothing, slopes=True)
        value_bar, radius_bar = (x.T.reshape(-1, *radius.shape) for x in found)
        found = value_bar, radius_bar[0]
        return tuple(blocks.add(x, index, y) for x, y in zip(bars, found, strict=True))

    bars = blocks.each(read_block, tuple(map(blocks.whole, bars)))
    value_bar, radius_bar = (x[..., : blocks.height, : blocks.width] for x in bars)
    return value_bar, radius_bar


class _Blocks:
    """How an image is divided, and where in a block's window the ends of its spans lie.

    A window is the block and `reach` pixels about it, and one more column on either side, as
    rounding may carry an end that far. Below it lies one row that nobody reads.
    """

    def __init__(self, reach: int, radius: Float[Array, "height width"]):
        self.reach, (self.height, self.width) = reach, radius.shape
        self.tall = min(BLOCK[0], self.height)
        self.wide = min(BLOCK[1], self.width)
        self.down, self.across = -(-self.height // self.tall), -(-self.width // self.wide)
        self.rows, self.columns = self.tall + 2 * reach, self.wide + 2 * reach + 2
        blocks = self.whole(radius).reshape(self.down, self.tall, self.across, self.wide)
        largest = blocks.max(axis=(1, 3)).reshape(-1)
        self.reaches = jnp.where(largest > 0, jnp.ceil(largest - POINT_RADIUS), -1).astype(int)

    def whole(self, x: Float[Array, "... height width"]) -> Float[Array, "... rows columns"]:
        """Filled up to whole blocks."""
        rows = self.down * self.tall - self.height
        columns = self.across * self.wide - self.width
        return jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, rows), (0, columns)])

    def windowed(self, x: Float[Array, "... height width"]) -> Float[Array, "... rows columns"]:
        """Whole blocks with the margins of their windows."""
        margins = [(self.reach, self.reach), (self.reach + 1, self.reach + 1)]
        return jnp.pad(self.whole(x), [(0, 0)] * (x.ndim - 2) + margins)

    def cut(
        self,
        x: Float[Array, "... rows columns"],
        index: Int[Array, ""],
        *,
        window: bool = False,
    ) -> Float[Array, "... tall wide"]:
        """A block or, of what has its margins, its window."""
        size = (self.rows, self.columns) if window else (self.tall, self.wide)
        return jax.lax.dynamic_slice(x, self._corner(x, index), (*x.shape[:-2], *size))

    def add(
        self,
        x: Float[Array, "... rows columns"],
        index: Int[Array, ""],
        block: Float[Array, "... tall wide"],
    ) -> Float[Array, "... rows columns"]:
        """Add to a block, or to its window."""
        at = self._corner(x, index)
        there = jax.lax.dynamic_slice(x, at, block.shape)
        return jax.lax.dynamic_update_slice(x, there + block, at)

    def _corner(self, x: Array, index: Int[Array, ""]) -> list[Any]:
        row, column = index // self.across, index % self.across
        return [0] * (x.ndim - 2) + [row * self.tall, column * self.wide]

    def each(self, visit: Callable, carry: Any) -> Any:
        """Fold `visit(index, carry)` over the blocks that hold a sprite."""
        empty = self.reaches < 0
        order = jnp.argsort(empty)
        return fori_loop(0, jnp.sum(~empty), lambda i, carry: visit(order[i], carry), carry)

    def each_row(self, index, radius, visit, carry, *, slopes):
        """Fold `visit(carry, side, end, cells, slope)` over the rows of a block's sprites.

        `side` is -1 for where spans begin and 1 for where they end, `end` is that place and
        `cells` are the two cells of the window, above and below, that it lies in. `slope` is
        the half-width's derivative in the radius.
        """
        y = jnp.arange(self.tall)[:, None] + self.reach
        x = jnp.arange(self.wide, dtype=radius.dtype) + (self.reach + 1.5)
        # Written out: XLA indexes a whole plane with less effort than a row of it.
        x = jnp.broadcast_to(x, radius.shape)

        def add_row(row, state):
            carry, lower = state
            upper = segment_integral(radius, row.astype(radius.dtype) + 0.5, slopes)
            width, *slope = (a - b for a, b in zip(upper, lower, strict=True))
            for side in (-1, 1):
                end = x + side * width
                column = jnp.floor(end).astype(int)
                # The middle row is its own mirror image.
                mirrored = jnp.where(row > 0, y - row, self.rows)
                cells = [
                    ((z * self.columns) + column).reshape(-1, 1) for z in (y + row, mirrored)
                ]
                carry = visit(carry, side, (end - jnp.floor(end)).reshape(-1, 1), cells, slope)
            return carry, upper

        lower = [-z for z in segment_integral(radius, jnp.asarray(0.5, radius.dtype), slopes)]
        return fori_loop(0, self.reaches[index] + 1, add_row, (carry, lower))[0]


def _add(steps: Array, cell: Array, step: Array) -> Array:
    dimensions = jax.lax.ScatterDimensionNumbers(
        update_window_dims=(1,),
        inserted_window_dims=(0,),
        scatter_dims_to_operand_dims=(0,),
    )
    mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.scatter_add(steps, cell, step, dimensions, mode=mode)


def _read(steps: Array, cell: Array) -> Array:
    return steps.at[cell[:, 0]].get(mode="promise_in_bounds")


def _flat(x: Float[Array, "... tall wide"]) -> Float[Array, "disc value"]:
    """One row per disc."""
    return x.reshape(-1, x.shape[-2] * x.shape[-1]).T
