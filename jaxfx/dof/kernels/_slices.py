"""Sheets of disc-shaped sprites, cut into slices of defocus and painted slice by slice.

A slice is the sprites of about one defocus, so that all of them have about one radius. Blocks
that hold none are skipped; in the others the sprites of the slice are gathered first, and then
painted by spans.

Where the defocus changes along a surface, its points crowd together as seen from one side of
the lens and thin out from the other: a sprite's weight at an offset is `1 + tilt . offset`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import cond, fori_loop, scan
from jaxfx._numerics import clip01
from jaxfx._xla import sum_planes
from jaxfx.dof.kernels._span_painter import Blocks, Discs, read, too_bright, write
from jaxfx.dof.sprites import reach


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


def across_of(reach: int) -> int:
    """How many pixels along a row a sprite reaches, its spans moved by the largest tilt.

    The largest tilt moves a span by at most a third of its radius: hence 4/3 of `reach + 1/2`.
    """
    return -(-4 * (2 * reach + 1) // 6) + 1


def _planes_of(sheets: Sheets) -> list[Float[Array, "sheet plane height width"]]:
    """The planes of value, radius, tilt and place, in the order of the rows of `Grid.discs`."""
    value, radius, tilt, place = sheets
    return [value, radius[:, None], tilt, place[:, None]]


class Grid:
    """Sheets divided into blocks, whose discs are painted slice by slice.

    - `blocks`: how a sheet is divided; all sheets are divided alike.
    - `shape`: values per sprite, and height and width of the frame.
    """

    def __init__(self, reach: int, sheets: Sheets):
        _, self.values, *padded = sheets.value.shape
        self.reach, self.across = reach, across_of(reach)
        self.blocks = Blocks(sheets.radius.shape[1:], BLOCK, (reach, self.across), beyond=reach)
        self.shape = self.values, *(n - 2 * reach for n in padded)

    def discs(self, sheets: Sheets) -> Float[Array, "block disc plane"]:
        """One row per disc: value, radius, tilt, place, and 1 if it is painted tap by tap.

        `place` is inf for a disc that is not painted.
        """
        place = jnp.where(self._is_painted(sheets), ordered(sheets.place), jnp.inf)
        by_taps = jax.vmap(too_bright)(sheets.value, sheets.radius).astype(place.dtype)
        planes = [*_planes_of(sheets._replace(place=place)), by_taps[:, None]]
        return self.blocks.listed(jnp.concatenate(planes, axis=1), jnp.inf)

    def dots(self, sheets_dots: Sheets) -> Float[Array, "block disc direction dot"]:
        """The tangents of value, radius, tilt and place, per disc and direction."""

        def of_direction(dot):
            return self.blocks.listed(jnp.concatenate(_planes_of(dot), axis=1))

        return jax.vmap(of_direction, out_axes=2)(sheets_dots)

    def planes(self, discs: Float[Array, "block disc plane"]) -> Sheets:
        """The sheets that `discs` were made of."""
        planes, v = self.blocks.planes(discs), self.values
        return Sheets(planes[:, :v], planes[:, v], planes[:, v + 1 : v + 3], planes[:, v + 3])

    def _is_painted(self, sheets: Sheets) -> Bool[Array, "sheet height width"]:
        """Mask of the sprites that are not hidden in full and that reach the frame."""

        def beyond_frame(size):
            """The distance of each row or column from the frame, in pixels."""
            from_middle = jnp.abs(jnp.arange(size, dtype=sheets.radius.dtype) - (size - 1) / 2)
            return jnp.maximum(from_middle - (size - 1) / 2 + self.reach, 0)

        above, beside = map(beyond_frame, sheets.radius.shape[1:])
        reaches = above[None, :, None] < sheets.radius + 0.5
        # Along a row the tilt moves a span by up to a third of the radius.
        reaches &= beside[None, None, :] < 4 / 3 * sheets.radius + 0.5
        return reaches & (sheets.value[:, -1] > 0)

    def each_slice(
        self, discs: Float[Array, "block disc plane"], visit: Callable, carry: Any
    ) -> Any:
        """Fold `visit(index, is_held, carry)` over the slices from the front.

        `is_held` is the mask of the blocks that hold sprites of the slice.
        """
        place = discs[..., self.values + 3]
        there = jnp.isfinite(place)
        low = jnp.where(there, place, jnp.inf).min()
        high = jnp.where(there, place, -jnp.inf).max()

        def add(index, carry):
            is_held = (share_of(place - index.astype(place.dtype)) > 0).any(axis=1)
            some = lambda carry: visit(index, is_held, carry)
            return cond(is_held.any(), some, lambda carry: carry, carry)

        first, last = jnp.floor(low).astype(int), jnp.ceil(high).astype(int)
        return fori_loop(first, last + 1, add, carry)

    def paint(
        self,
        index: Int[Array, ""],
        is_held: Bool[Array, " block"],
        discs: Float[Array, "block disc plane"],
        dots: Float[Array, "block disc direction dot"] | None = None,
    ) -> Float[Array, "value height width"]:
        """The sum of a slice's sprites in the frame; given `dots`, then its tangents too."""
        v = self.values

        def write_chunk(block, steps, ids, share, share_slope, tap):
            disc = self._disc(discs[block, ids])
            shared = disc._replace(value=disc.value * share[:, None])
            dot = None
            if dots is not None:
                rows = dots[block, ids]
                dot = self._disc(rows)
                value_dot = dot.value * share[:, None, None]
                share_dot = share_slope[:, None] * rows[..., v + 3]
                value_dot = value_dot + disc.value[:, None] * share_dot[..., None]
                dot = dot._replace(value=value_dot)
            # What belongs to another slice only fills up the chunk: its radius must not count.
            shared = shared._replace(radius=jnp.where(share > 0, disc.radius, 0))
            places = self.blocks.places(disc.value.dtype, ids, tap)
            return write(self.blocks, places, shared, steps, dot)

        def write_block(block, steps):
            return self._each_chunk(index, block, discs, write_chunk, steps)

        shape = (1 if dots is None else 1 + dots.shape[2]), v
        return self.blocks.paint(is_held, write_block, shape, discs.dtype)

    def read_back(
        self,
        index: Int[Array, ""],
        is_held: Bool[Array, " block"],
        discs: Float[Array, "block disc plane"],
        bar: Float[Array, "value height width"],
        bars: Float[Array, "block disc plane"],
    ) -> Float[Array, "block disc plane"]:
        """The adjoint of `paint`.

        `bar` is the cotangent of `paint`'s result. The cotangent of `discs` is added to `bars`.
        """

        def read_block(block, steps, bars):
            def read_chunk(block, bars, ids, share, share_slope, tap):
                disc = self._disc(discs[block, ids])
                disc = disc._replace(radius=jnp.where(share > 0, disc.radius, 0))
                places = self.blocks.places(disc.value.dtype, ids, tap)
                found = read(self.blocks, places, disc, steps)
                place_bar = share_slope * sum_planes(disc.value * found.value, 1)
                planes = [x * share for x in (found.radius, *(found.tilt or ()))]
                planes += [place_bar, jnp.zeros_like(share)]
                planes = [found.value * share[:, None], *(x[:, None] for x in planes)]
                return bars.at[block, ids].add(jnp.concatenate(planes, axis=1))

            return self._each_chunk(index, block, discs, read_chunk, bars)

        return self.blocks.read_back(is_held, read_block, bar, bars)

    def _disc(self, rows: Float[Array, "disc *direction plane"]) -> Discs:
        """Some rows of `discs` or `dots` without what belongs to slices."""
        v = self.values
        return Discs(rows[..., :v], rows[..., v], (rows[..., v + 1], rows[..., v + 2]))

    def _each_chunk(self, index, block, discs, visit, carry):
        """Fold `visit(block, carry, ids, share, share_slope, tap)` over a slice's discs.

        - `ids`: numbers in the block of some discs; the last chunk is filled up with any.
        - `share`, `share_slope`: how much of each disc belongs to the slice, and its slope.
        - `tap`: the column of each, for discs that are painted tap by tap, once per column.
        """
        beyond = discs[block, :, self.values + 3] - index.astype(discs.dtype)
        bright = discs[block, :, self.values + 4] > 0
        columns = jnp.arange(-self.across, self.across + 1)

        def fold(carry, held, chunk, column):
            size, taps = len(held), 1 if column is None else len(column)
            at = jnp.where(held, self._held_before(held), size + chunk)
            ids = jnp.zeros(size + chunk, int).at[at].set(jnp.arange(size), mode="drop")
            count = held.sum()

            def visit_chunk(n, carry):
                chunk_ids = jax.lax.dynamic_slice_in_dim(ids, n * chunk, chunk)
                is_disc = jnp.repeat(n * chunk + jnp.arange(chunk) < count, taps)
                chunk_ids = jnp.repeat(chunk_ids, taps)
                share, share_slope = (
                    jnp.where(is_disc, f(beyond[chunk_ids]), 0)
                    for f in (share_of, share_slope_of)
                )
                tap = None if column is None else jnp.tile(column, chunk)
                return visit(block, carry, chunk_ids, share, share_slope, tap)

            return fori_loop(0, -(-count // chunk), visit_chunk, carry)

        held = share_of(beyond) > 0
        carry = fold(carry, held & ~bright, CHUNK, None)
        too_bright = held & bright
        fold_bright = lambda carry: fold(carry, too_bright, BRIGHT_CHUNK, columns)
        return cond(too_bright.any(), fold_bright, lambda carry: carry, carry)

    def _held_before(self, held: Bool[Array, " disc"]) -> Int[Array, " disc"]:
        """How many discs of a block are held before each, row by row.

        By a loop over columns: XLA:CPU takes three times as long for a cumulative sum.
        """
        columns = held.reshape(self.blocks.block).T.astype(jnp.int32)
        nothing = jnp.zeros_like(columns[0])
        counts, before = scan(lambda sums, x: (sums + x, sums), nothing, columns)
        above = jnp.cumsum(counts) - counts
        return (above[None] + before).T.reshape(-1)
