"""Painting the disc-shaped sprites of one slice of defocus, and the adjoint of that.

Each row of a disc is a span of pixels. Only its two ends are written; a running sum along the
row then fills it. This is done block by block.

A slice is the sprites of about one defocus, so that all of them have about one radius. Blocks
that hold none are skipped; in the others the sprites of the slice are gathered first.

Where the defocus changes along a surface, its points crowd together as seen from one side of
the lens and thin out from the other: a sprite's weight at an offset is `1 + tilt . offset`.
Each row is weighted by the factor for its y. Along x a span has one weight; instead it is moved
by `tilt_x * half_width**2 / 3`, which keeps its sum and gives it the right centre of mass.

A running sum keeps the rounding errors of the values that it has passed. Sprites that are much
brighter than the sum in a pixel are therefore painted pixel by pixel ("tap by tap") instead.

Known limit: XLA runs a scatter on one core.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import cond, fori_loop
from jaxfx._numerics import clip01
from jaxfx._xla import sum_planes
from jaxfx.dof.kernels._paint import _add, _read
from jaxfx.dof.kernels._spans import _too_bright
from jaxfx.dof.kernels._tiles import inside
from jaxfx.dof.sprites import POINT_RADIUS, reach, segment_integral


# Height and width of a block in pixels: with the margin that its sprites reach it takes half a
# megabyte at a radius of 32, which fits a core's cache. Larger blocks do not.
BLOCK = (64, 64)
# Sprites painted per iteration of a loop: by spans, and tap by tap. Larger values waste work in
# the last iteration, which is rarely full; smaller ones need more iterations.
CHUNK, BRIGHT_CHUNK = 1024, 16
# The most slices to either side of the focus: bounds the time for a tiny threshold.
SLICES = 128
# Difference between the slice numbers of one sheet and those of the next. It exceeds the number
# of slices that a sheet can have, so that no two sheets share a number.
APART = 2 * SLICES + 2


class Extent(NamedTuple):
    """The largest sprite and the number of slices, both static (known at compile time).

    - `max_coc`: the largest diameter of a circle of confusion, pixels.
    - `slices`: the number on each side of the focus, `max_coc / threshold` rounded up. None if
      the threshold is traced.
    """

    max_coc: float
    slices: int | None

    @property
    def reach(self) -> int:
        """How many pixels away, along an axis, any sprite covers anything."""
        return reach(self.max_coc)

    def reach_of(self, radius: float) -> int:
        """Like `reach`, for sprites of at most this radius."""
        return reach(min(2 * radius, self.max_coc))


class Sheets(NamedTuple):
    """Layers of sprites, one per pixel, padded by `reach` pixels on each side of the frame.

    - `value`: the colour channels and then a 1, all times the share of the sprite that no other
      layer hides, over the area of its disc.
    - `radius`: pixels.
    - `tilt`: the gradient along x and y of the logarithm of the defocus; its length is at most
      `1 / (radius + 1/2)`, so that no weight `1 + tilt . offset` is negative.
    - `place`: the signed defocus over the threshold, that is, in slices; at most `SLICES`.
    """

    value: Float[Array, "sheet value height width"]
    radius: Float[Array, "sheet height width"]
    tilt: Float[Array, "sheet 2 height width"]
    place: Float[Array, "sheet height width"]


def ordered(place: Float[Array, "sheet height width"]) -> Float[Array, "sheet height width"]:
    """Each sprite's `place`, increased so that every sheet lies behind the one before it."""
    apart = jax.lax.stop_gradient(jnp.ceil(place.max()) - jnp.floor(place.min()) + 2)
    return place + apart * jnp.arange(len(place), dtype=place.dtype)[:, None, None]


def share_of(beyond: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Share of a sprite that belongs to a slice at a distance, in slices: 1 at 0, 0 from 1 on.

    The shares of the two nearest slices add up to 1. The function is smooth, so that no
    derivative is lost at a kink.
    """
    t = clip01(jnp.abs(beyond))
    return 1 - t * t * (3 - 2 * t)


def share_slope_of(beyond: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The derivative of `share_of`."""
    t = clip01(jnp.abs(beyond))
    return -6 * jnp.sign(beyond) * t * (1 - t)


def _begun(
    value: Float[Array, "disc value"],
) -> tuple[Float[Array, "disc step"], Float[Array, "disc step"]]:
    """What the start of a span adds to the running sum, and to the sum's correction.

    The correction is for the pixel in which the span starts, which it covers in part.
    """
    nothing = jnp.zeros_like(value)
    return jnp.concatenate([value, nothing], axis=1), jnp.concatenate([nothing, value], axis=1)


def across_of(reach: int) -> int:
    """How many pixels along a row a sprite reaches, its spans moved by the largest tilt.

    The largest tilt moves a span by at most a third of its radius: hence 4/3 of `reach + 1/2`.
    """
    return -(-4 * (2 * reach + 1) // 6) + 1


class _End(NamedTuple):
    """The starts (`side` -1) or the ends (1) of the spans of some discs, in one row of each.

    - `row`: offset of the row from the centre of the disc, in pixels.
    - `cell`: flat index of the window's pixel in which the end lies.
    - `cut`: where in that pixel the end lies, 0 at its left border to 1 at its right.
    - `facing`: the weight of the row, `1 + tilt_y * row`.
    - `by_tilt`, `by_radius`: derivatives of the x of the end with respect to the tilt along x
      and to the radius.
    - `whole`: 1 for spans. 0 for taps (single pixels painted without the running sum): `cut` is
      then the coverage of the pixel, and `by_tilt` and `by_radius` are its derivatives.
    """

    side: int
    whole: int
    row: Array
    cut: Array
    cell: Array
    facing: Array
    by_tilt: Array
    by_radius: Any = 0


class Grid:
    """Sheets divided into blocks, and the window into which a block's spans are painted.

    A window is the block with the margin that its sprites can reach. One more row below it
    takes writes that are to be discarded.

    - `reach`, `across`: margin of a window along y and along x, pixels.
    - `sheets`, `values`: the number of sheets, and of values per sprite.
    - `height`, `width`: of the frame; `padded`: both with the padding of the sheets.
    - `blocks`: number of blocks down and across; `block`: height and width of one, pixels.
    - `rows`, `columns`: height and width of a window.
    """

    def __init__(self, reach: int, sheets: Sheets):
        self.reach, self.across = reach, across_of(reach)
        self.sheets, self.values, *padded = sheets.value.shape
        self.height, self.width = (n - 2 * reach for n in padded)
        self.padded = padded
        counts = (max(1, round(n / side)) for n, side in zip(padded, BLOCK, strict=True))
        self.blocks = down, across = tuple(counts)
        self.block = tall, wide = -(-padded[0] // down), -(-padded[1] // across)
        self.rows, self.columns = tall + 2 * reach, wide + 2 * self.across

    def discs(
        self, sheets: Sheets, dot: Sheets | None = None
    ) -> Float[Array, "block disc plane"]:
        """One row per disc: value, radius, tilt, place, and 1 if it is painted tap by tap.

        `place` is inf for a disc that is not painted. Given `dot`, the tangents of `sheets`,
        the result has the tangents of value, radius, tilt and place instead.
        """
        value, radius, tilt, place = dot or sheets
        by_taps, fill = jnp.zeros_like(place), 0.0
        if dot is None:
            place = jnp.where(self._counts(sheets), ordered(place), jnp.inf)
            by_taps = jax.vmap(_too_bright)(value, radius).astype(place.dtype)
            fill = jnp.inf
        planes = [value, radius[:, None], tilt, place[:, None], by_taps[:, None]]
        planes = jnp.concatenate(planes, axis=1)
        sides = [
            (0, count * side - n)
            for count, side, n in zip(self.blocks, self.block, planes.shape[2:], strict=True)
        ]
        planes = jnp.pad(planes, [(0, 0), (0, 0), *sides], constant_values=fill)
        (down, across), (tall, wide) = self.blocks, self.block
        planes = planes.reshape(self.sheets, -1, down, tall, across, wide)
        return planes.transpose(0, 2, 4, 3, 5, 1).reshape(-1, tall * wide, planes.shape[1])

    def planes(self, discs: Float[Array, "block disc plane"]) -> Sheets:
        """The sheets that `discs` were made of."""
        (down, across), (tall, wide) = self.blocks, self.block
        planes = discs.reshape(self.sheets, down, across, tall, wide, -1)
        planes = planes.transpose(0, 5, 1, 3, 2, 4)
        planes = planes.reshape(self.sheets, -1, down * tall, across * wide)
        height, width = self.padded
        planes, v = planes[..., :height, :width], self.values
        return Sheets(planes[:, :v], planes[:, v], planes[:, v + 1 : v + 3], planes[:, v + 3])

    def _counts(self, sheets: Sheets) -> Bool[Array, "sheet height width"]:
        """Mask of the sprites that are not hidden in full and that reach the frame."""
        far = [
            jnp.maximum(
                jnp.abs(jnp.arange(n, dtype=sheets.radius.dtype) - (n - 1) / 2)
                - (n - 1) / 2
                + self.reach,
                0,
            )
            for n in self.padded
        ]
        rows, columns = far
        reaches = rows[None, :, None] < sheets.radius + 0.5
        reaches &= columns[None, None, :] < 4 / 3 * sheets.radius + 0.5
        return reaches & (sheets.value[:, -1] > 0)

    def each_slice(
        self, discs: Float[Array, "block disc plane"], visit: Callable, carry: Any
    ) -> Any:
        """Fold `visit(index, blocks, count, carry)` over the slices from the front.

        The first `count` of `blocks` hold sprites of the slice.
        """
        place = discs[..., self.values + 3]
        there = jnp.isfinite(place)
        low = jnp.where(there, place, jnp.inf).min()
        high = jnp.where(there, place, -jnp.inf).max()

        def add(index, carry):
            held = (share_of(place - index.astype(place.dtype)) > 0).any(axis=1)
            count = held.sum()
            some = lambda carry: visit(index, jnp.argsort(~held), count, carry)
            return cond(count > 0, some, lambda carry: carry, carry)

        first, last = jnp.floor(low).astype(int), jnp.ceil(high).astype(int)
        return fori_loop(first, last + 1, add, carry)

    def paint(
        self,
        index: Int[Array, ""],
        blocks: Int[Array, " block"],
        count: Int[Array, ""],
        discs: Float[Array, "block disc plane"],
        dots: Float[Array, "block disc plane"] | None = None,
    ) -> Float[Array, "value height width"]:
        """The sum of a slice's sprites in the frame; with tangents `dots`, then its tangent."""
        v = self.values
        channels = v if dots is None else 2 * v

        def paint_chunk(steps, block, ids, share, share_slope, column):
            disc = discs[block, ids]
            shared = share[:, None]
            value = disc[:, :v] * shared
            whole, part = _begun(value)

            def visit(steps, end):
                step = end.whole * whole + end.cut[:, None] * part
                step = (-end.side * end.facing)[:, None] * step
                return _add(steps, end.cell[:, None], step)

            def visit_dot(dot, whole_dot, part_dot, steps, end):
                facing = (-end.side * end.facing)[:, None]
                turned = -end.side * end.row * dot[:, v + 2]
                moved = end.by_radius * dot[:, v] + end.by_tilt * dot[:, v + 1]
                step = end.whole * whole + end.cut[:, None] * part
                step_dot = end.whole * whole_dot + end.cut[:, None] * part_dot
                step_dot = facing * (step_dot + moved[:, None] * part)
                step_dot = step_dot + turned[:, None] * step
                step = jnp.concatenate([facing * step, step_dot], axis=1)
                return _add(steps, end.cell[:, None], step)

            if dots is not None:
                dot = dots[block, ids]
                value_dot = dot[:, :v] * shared
                value_dot = value_dot + disc[:, :v] * (share_slope * dot[:, v + 3])[:, None]
                visit = ft.partial(visit_dot, dot, *_begun(value_dot))
            slopes = dots is not None
            return self._each_end(disc, ids, share, column, visit, steps, slopes=slopes)

        def paint_block(n, canvas):
            steps = jnp.zeros(((self.rows + 1) * self.columns, 2 * channels), discs.dtype)
            steps = self._each_chunk(index, blocks[n], discs, paint_chunk, steps)
            steps = steps.reshape(self.rows + 1, self.columns, -1, 2, v)[:-1]
            painted = jax.lax.cumsum(steps[..., 0, :], axis=1) - steps[..., 1, :]
            painted = painted.reshape(self.rows, self.columns, channels)
            at = self._corner(blocks[n])
            painted = jnp.moveaxis(painted, -1, 0)
            there = jax.lax.dynamic_slice(canvas, at, painted.shape)
            return jax.lax.dynamic_update_slice(canvas, there + painted, at)

        canvas = fori_loop(0, count, paint_block, self._canvas(channels, discs.dtype))
        y, x = 2 * self.reach, self.reach + self.across
        return canvas[:, y : y + self.height, x : x + self.width]

    def read_back(
        self,
        index: Int[Array, ""],
        blocks: Int[Array, " block"],
        count: Int[Array, ""],
        discs: Float[Array, "block disc plane"],
        bar: Float[Array, "value height width"],
        bars: Float[Array, "block disc plane"],
    ) -> Float[Array, "block disc plane"]:
        """The adjoint of `paint`: it reads the window where `paint` writes it.

        `bar` is the cotangent of `paint`'s result. The cotangent of `discs` is added to `bars`.
        """
        v = self.values
        canvas = self._canvas(v, discs.dtype)
        at = (0, 2 * self.reach, self.reach + self.across)
        canvas = jax.lax.dynamic_update_slice(canvas, bar, at)

        def read_block(n, bars):
            shape = v, self.rows, self.columns
            seen = jax.lax.dynamic_slice(canvas, self._corner(blocks[n]), shape)
            seen = jnp.moveaxis(seen, 0, -1)
            ahead = jax.lax.cumsum(seen, axis=1, reverse=True)
            steps = jnp.concatenate([ahead, seen], axis=-1)
            steps = jnp.pad(steps, ((0, 1), (0, 0), (0, 0))).reshape(-1, 2 * v)

            def read_chunk(bars, block, ids, share, share_slope, column):
                disc = discs[block, ids]
                value = disc[:, :v]

                def visit(found, end):
                    value_bar, radius_bar, *tilt_bar = found
                    step = _read(steps, end.cell[:, None])
                    ahead, here = step[:, :v], step[:, v:]
                    arriving = -end.side * (end.whole * ahead - end.cut[:, None] * here)
                    moving = end.side * end.facing * sum_planes(value * here, 1)
                    return (
                        value_bar + end.facing[:, None] * arriving,
                        radius_bar + end.by_radius * moving,
                        tilt_bar[0] + end.by_tilt * moving,
                        tilt_bar[1] + end.row * sum_planes(value * arriving, 1),
                    )

                zero = jnp.zeros_like(share)
                nothing = jnp.zeros_like(value), zero, zero, zero
                value_bar, *rest = self._each_end(
                    disc, ids, share, column, visit, nothing, slopes=True
                )
                place_bar = share_slope * sum_planes(value * value_bar, 1)
                found = [value_bar * share[:, None]]
                found += [x[:, None] for x in (*(x * share for x in rest), place_bar, zero)]
                return bars.at[block, ids].add(jnp.concatenate(found, axis=1))

            return self._each_chunk(index, blocks[n], discs, read_chunk, bars)

        return fori_loop(0, count, read_block, bars)

    def _canvas(self, channels: int, dtype: Any) -> Float[Array, "value rows columns"]:
        (down, across), (tall, wide) = self.blocks, self.block
        size = down * tall + 2 * self.reach, across * wide + 2 * self.across
        return jnp.zeros((channels, *size), dtype)

    def _corner(self, block: Int[Array, ""]) -> tuple[Any, ...]:
        """Start of a block's window in the canvas."""
        (down, across), (tall, wide) = self.blocks, self.block
        block = block % (down * across)
        return 0, block // across * tall, block % across * wide

    def _each_chunk(self, index, block, discs, visit, carry):
        """Fold `visit(carry, block, discs, share, its slope, column)` over a slice's discs.

        A disc that is painted tap by tap comes once per `column`; for others `column` is None.
        """
        beyond = discs[block, :, self.values + 3] - index.astype(discs.dtype)
        bright = discs[block, :, self.values + 4] > 0
        columns = jnp.arange(-self.across, self.across + 1)

        def fold(carry, held, chunk, column):
            size, taps = len(held), 1 if column is None else len(column)
            at = jnp.where(held, jnp.cumsum(held) - 1, size + chunk)
            ids = jnp.zeros(size + chunk, int).at[at].set(jnp.arange(size), mode="drop")
            count = held.sum()

            def each(n, carry):
                mine = jax.lax.dynamic_slice_in_dim(ids, n * chunk, chunk)
                there = jnp.repeat(n * chunk + jnp.arange(chunk) < count, taps)
                mine = jnp.repeat(mine, taps)
                away = beyond[mine]
                of_slice, slope = (
                    jnp.where(there, f(away), 0) for f in (share_of, share_slope_of)
                )
                tap = None if column is None else jnp.tile(column, chunk)
                return visit(carry, block, mine, of_slice, slope, tap)

            return fori_loop(0, -(-count // chunk), each, carry)

        held = share_of(beyond) > 0
        carry = fold(carry, held & ~bright, CHUNK, None)
        return fold(carry, held & bright, BRIGHT_CHUNK, columns)

    def _each_end(self, disc, ids, share, column, visit, carry, *, slopes):
        """Fold `visit(carry, end)` over the ends of the discs' spans, or over their taps."""
        v = self.values
        radius, tilt_x, tilt_y = disc[:, v], disc[:, v + 1], disc[:, v + 2]
        y = ids // self.block[1] + self.reach
        x = (ids % self.block[1] + self.across).astype(disc.dtype) + 0.5
        largest = jnp.where(share > 0, radius, 0).max()

        def ends(width, slope):
            by_tilt = width * width / 3
            for side in (-1, 1):
                end = x + tilt_x * by_tilt + side * width
                cell = jnp.floor(end)
                by_radius = [(side + tilt_x * width * (2 / 3)) * z for z in slope]
                yield side, 1, end - cell, cell.astype(int), by_tilt, *by_radius

        def tap(width, slope):
            by_tilt = width * width / 3
            middle = tilt_x * by_tilt + 0.5 - column.astype(disc.dtype)
            start, end = middle - width, middle + width
            moving = inside(end) - inside(start)
            growing = inside(end) + inside(start) + moving * tilt_x * width * (2 / 3)
            cover, cell = clip01(end) - clip01(start), x.astype(int) + column
            yield 1, 0, cover, cell, moving * by_tilt, *(growing * z for z in slope)

        def add_row(row, state):
            carry, lower = state
            height = row.astype(disc.dtype)
            upper = segment_integral(radius, height + 0.5, slopes)
            width, *slope = (a - b for a, b in zip(upper, lower, strict=True))
            for side, whole, cut, cell, *by in (ends if column is None else tap)(width, slope):
                for way in (1, -1):
                    # The middle row is its own mirror image: the second write is discarded.
                    there = y + row if way > 0 else jnp.where(row > 0, y - row, self.rows)
                    cells = there * self.columns + cell
                    facing = 1 + (way * height) * tilt_y
                    end = _End(side, whole, way * height, cut, cells, facing, *by)
                    carry = visit(carry, end)
            return carry, upper

        # The integral up to -1/2, the lower border of the middle row: it is odd in the height.
        lower = [-z for z in segment_integral(radius, jnp.asarray(0.5, disc.dtype), slopes)]
        rows = jnp.ceil(largest - POINT_RADIUS).astype(int) + 1
        return fori_loop(0, rows, add_row, (carry, lower))[0]
