"""Scatter as a gather, tile by tile, each tile as far as the sprites that can reach it.

Every tile loops over rows of offsets, out to the largest radius that matters to it, and along a
row in runs of 17, out to where that radius ends there. The offsets of a run are written out, so
that sums stay in registers. A row and its mirror image share
their half-widths, and the integral at a row's upper edge is the next row's lower one. The
adjoint is the same sweep with the tiles owned by the sources: no scatter is left in either.

What it does not do well: one large sprite makes all pixels of its tile pay, and the cost grows
with the square of the radius.
"""

import functools as ft
from collections.abc import Callable
from itertools import count, takewhile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxfx._loops import fori_loop, switch
from jaxfx._platform import by_platform, one_by_one
from jaxfx.dof.kernels import _taps
from jaxfx.dof.kernels._adjoint import Program, with_adjoint
from jaxfx.dof.kernels._rows import ROWS
from jaxfx.dof.kernels._shift import shift
from jaxfx.dof.kernels._taps import Planes, Sweep, clip, inside, stacked, to_planes
from jaxfx.dof.sprites import POINT_RADIUS, Sprites, segment_integral


# Tall enough to spread a row's overhead, wide for the vector units, small enough for the cache.
TILE = (64, 128)
# A run of fewer than 17 taps takes XLA three times as long per tap: it reads each one through a
# dynamic slice, which it lays out in memory for more readers than 16. The middle run is the one
# of the 8 offsets to either side.
RUN, NEAR = 17, 8
# Where "shift" adds fewer taps than this, it compiles sooner than "tiles", by half a second: as
# much as forty calls take longer.
_FEW_TAPS = 2**20


def tiles(sprites: Sprites, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    return jnp.moveaxis(_sums(reach, to_planes(sprites)), 0, -1)


def sum_all(
    value: Float[Array, "height width value"], radius: Float[Array, "height width"], reach: int
) -> Float[Array, "height width value"]:
    """The sums over all sprites, whatever hides or rejects them, by the quicker program."""
    zero, one = jnp.zeros_like(radius), jnp.ones((), radius.dtype)
    sprites = Sprites(value, radius, zero - 1, zero, one)
    if radius.size * (2 * reach + 1) ** 2 >= _FEW_TAPS:
        return jnp.moveaxis(_all(reach, to_planes(sprites)), 0, -1)
    by_rows = lambda sprites: jnp.moveaxis(_by_rows(reach, to_planes(sprites)), 0, -1)
    return by_platform(sprites, cpu=lambda sprites: shift(sprites, reach), accelerator=by_rows)


def plain(reach: int, planes: Planes) -> Float[Array, "value height width"]:
    """The same sums by `shift`, which JAX can differentiate again."""
    value, radius, leak, coc = planes
    one = jnp.ones((), radius.dtype)
    return stacked(shift(Sprites(jnp.moveaxis(value, 0, -1), radius, leak, coc, one), reach))


def _sweep(
    tap: Callable[..., list[Array]],
    reach: int,
    radius: Float[Array, "height width"],
    own: list[Array],
    other: list[Array],
    *,
    by_source: bool,
    slopes: bool,
) -> list[Array]:
    """`Sweep.sums` of `_taps`, tile by tile."""
    height, width = radius.shape
    tall, wide = min(TILE[0], -(-height // 8) * 8), min(TILE[1], -(-width // 8) * 8)
    rows, columns = -(-height // tall), -(-width // wide)
    halos = _halos(reach)
    most = halos[-1]
    reaches = _tile_reaches(radius, tall, wide, spread=not by_source)

    def padded(planes, fill=0.0):
        sides = ((most, most + rows * tall - height), (most, most + columns * wide - width))
        margin = [(0, 0)] * (planes.ndim - 2) + [*sides]
        return jnp.pad(planes, margin, constant_values=fill)

    def cut(planes, index, halo):
        start = (index // columns * tall + most - halo, index % columns * wide + most - halo)
        planes = jax.lax.dynamic_slice_in_dim(planes, start[0], tall + 2 * halo, axis=-2)
        return jax.lax.dynamic_slice_in_dim(planes, start[1], wide + 2 * halo, axis=-1)

    radius, own, other = (
        padded(radius, POINT_RADIUS),
        [*map(padded, own)],
        [*map(padded, other)],
    )

    def tile(halo: int, index: Int[Array, ""]) -> list[Array]:
        mine = [cut(planes, index, 0) for planes in own]
        theirs = [cut(planes, index, halo) for planes in other]
        sprite = cut(radius, index, 0 if by_source else halo)

        def add_row(row, carry):
            sums, lower = carry
            upper = segment_integral(sprite, row.astype(sprite.dtype) + 0.5, slopes)
            widths = [x - y for x, y in zip(upper, lower, strict=True)]
            runs = _runs(reaches[index], row)

            def add_side(side, sums):
                shift = ft.partial(_rows, start=halo + (1 - 2 * side) * row, size=tall)
                there = [*map(shift, theirs)]
                spans = widths if by_source else [*map(shift, widths)]
                add = ft.partial(_add_run, tap, mine, there, spans, by_source=by_source)
                near = min(NEAR, halo)
                sums = add(sums, halo - near, 2 * near + 1, ft.partial(_near_edge, near))
                if halo <= NEAR:
                    return sums
                far = lambda run, sums: add(sums, *_far_run(halo, runs, run, sprite.dtype))
                return fori_loop(0, 2 * runs, far, sums)

            # The middle row is its own mirror image.
            return fori_loop(0, jnp.where(row > 0, 2, 1), add_side, sums), upper

        nothing = [jnp.zeros((tall, wide), sprite.dtype)] * (2 if slopes else 1)
        shapes = jax.eval_shape(tap, *nothing, mine, [x[..., :tall, :wide] for x in theirs])
        sums = [jnp.zeros(x.shape, x.dtype) for x in shapes]
        lower = [-x for x in segment_integral(sprite, jnp.asarray(0.5, sprite.dtype), slopes)]
        return fori_loop(0, reaches[index] + 1, add_row, (sums, lower))[0]

    branches = [ft.partial(tile, halo) for halo in halos]

    def one(index):
        fitting = jnp.searchsorted(jnp.asarray(halos), reaches[index])
        return switch(fitting, branches, index)

    def assembled(tiles):
        tiles = tiles.reshape(rows, columns, -1, tall, wide).transpose(2, 0, 3, 1, 4)
        return tiles.reshape(-1, rows * tall, columns * wide)[:, :height, :width]

    sums = jax.lax.map(one, jnp.arange(rows * columns))
    return [assembled(x) if x.ndim == 4 else assembled(x)[0] for x in sums]


def _add_run(tap, mine, there, spans, sums, start, size, edge, *, by_source):
    """Add the taps of a run of offsets, the first of which reads its row from `start`.

    `edge` gives how far a span passes into the run's pixel k, and by what factor that grows
    with its half-width.
    """
    wide = mine[0].shape[-1]
    cut = ft.partial(_columns, start=start, size=wide + size - 1)
    there = [*map(cut, there)]
    spans = spans if by_source else [*map(cut, spans)]
    for k in range(size):
        at = slice(k, k + wide)
        width, *width_dot = spans if by_source else [x[:, at] for x in spans]
        passed, factor = edge(width, k)
        covers = [clip(passed), *(inside(passed) * factor * x for x in width_dot)]
        taps = tap(*covers, mine, [x[..., at] for x in there])
        sums = [x + y for x, y in zip(sums, taps, strict=True)]
    return sums


def _near_edge(near: int, width: Array, k: int) -> tuple[Array, int]:
    distance = abs(k - near)
    return (width + (0.5 - distance), 1) if distance else (2 * width, 2)


def _far_run(halo: int, runs: Array, run: Array, dtype: DTypeLike) -> tuple[Any, ...]:
    """Where one of the runs -n, ..., -1, 1, ..., n begins, its size, its `edge`.

    One to the left begins with its farthest offset.
    """
    right = run >= runs
    first = NEAR + 1 + jnp.where(right, run - runs, runs - 1 - run) * RUN
    last = first + RUN - 1
    begin = 0.5 - jnp.where(right, first, last).astype(dtype)
    toward = jnp.where(right, -1, 1).astype(dtype)
    edge = lambda width, k: (width + (begin + k * toward), 1)
    return halo + jnp.where(right, first, -last), RUN, edge


def _halos(reach: int) -> list[int]:
    """How much of a tile's surroundings its programs see: for tiles that nothing reaches, the
    middle run, and further runs, each about three times as far as the one before.
    """
    runs = max(0, -(-(reach - NEAR) // RUN))
    grown = takewhile(lambda n: 2 * n < runs, (3**n for n in count()))
    return [0, NEAR, *(NEAR + n * RUN for n in grown)] + [NEAR + runs * RUN] * (runs > 0)


def farthest(reach: int) -> int:
    """How far along a row the runs go that hold what reaches so far."""
    return _halos(reach)[-1]


def _runs(reach: Int[Array, ""], row: Int[Array, ""]) -> Int[Array, ""]:
    """How many runs beyond the middle one a disc of that reach covers in a row, per side."""
    radius = reach.astype(jnp.float32) + POINT_RADIUS
    height = jnp.maximum(row.astype(jnp.float32) - 0.5, 0)
    half_chord = jnp.sqrt(jnp.maximum((radius - height) * (radius + height), 0))
    columns = jnp.ceil(half_chord - 0.5 + 1e-3).astype(int)
    return jnp.maximum(0, (columns - NEAR + RUN - 1) // RUN)


def _rows(planes: Array, start: Array, size: int) -> Array:
    return jax.lax.dynamic_slice_in_dim(planes, start, size, axis=-2)


def _columns(planes: Array, start: Array | int, size: int) -> Array:
    return jax.lax.dynamic_slice_in_dim(planes, start, size, axis=-1)


def _tile_reaches(
    radius: Float[Array, "height width"], tall: int, wide: int, *, spread: bool
) -> Int[Array, " tile"]:
    """How far the sprites of a tile reach or, with `spread`, those that reach the tile."""
    tile = (tall, wide)
    counts = [-(-n // side) for n, side in zip(radius.shape, tile, strict=True)]
    margin = [(0, m * side - n) for n, m, side in zip(radius.shape, counts, tile, strict=True)]
    blocks = jnp.pad(radius, margin).reshape(counts[0], tile[0], counts[1], tile[1])
    reach = jnp.ceil(blocks.max(axis=(1, 3)) - POINT_RADIUS).astype(int)
    if spread:
        gaps = []
        for count, side in zip(counts, tile, strict=True):
            apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
            gaps.append(np.where(apart > 0, (apart - 1) * side + 1, 0))
        far = np.maximum(gaps[0][:, None, :, None], gaps[1][None, :, None, :])
        there = jnp.broadcast_to(reach, far.shape)
        reach = jnp.where(far <= there, there, 0).max(axis=(2, 3))
    return reach.reshape(-1)


_SWEEP = Sweep(_sweep, clip)
forward = ft.partial(_taps.forward, _SWEEP)
tangents = one_by_one(ft.partial(_taps.tangent, _SWEEP))
adjoint = ft.partial(_taps.adjoint, _SWEEP)
TILES = Program(forward, tangents, adjoint)
SHIFTS = Program(plain, tangents, adjoint)  # the derivatives of `shift` take longer
_sums = with_adjoint(TILES, plain)
_all = with_adjoint(TILES, plain, ROWS)
_by_rows = with_adjoint(ROWS, plain)
