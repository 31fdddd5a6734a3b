"""Scatter turned round, tile by tile, each tile as far as the sprites that can reach it.

Every tile loops over rows of offsets, out to the largest radius that matters to it; the offsets
along a row are written out, so that sums stay in registers. A row and its mirror image share
their half-widths, and the integral at a row's upper edge is the next row's lower one. The
adjoint is the same sweep with the tiles owned by the sources: no scatter is left in either.

What it does not do well: one large sprite makes all pixels of its tile pay, and the cost grows
with the square of the radius.
"""

import functools as ft
import math
from collections.abc import Callable
from itertools import count, takewhile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int

from jaxfx._numerics import clip01
from jaxfx.dof._shift import shift
from jaxfx.dof._sprites import POINT_RADIUS, Sprites


# Tall enough to spread a row's overhead, wide for the vector units, small enough for the cache.
TILE = (64, 128)
# A row of fewer than 17 taps takes XLA three times as long a tap: it reads every one through a
# dynamic slice, which it lays out in memory for more readers than 16.
LEAST_HALO = 8


class _Planes(NamedTuple):
    """Sprites as the kernel reads them, with `leak` and `coc` in units of epsilon."""

    value: Float[Array, "value height width"]
    radius: Float[Array, "height width"]
    leak: Float[Array, "height width"]
    coc: Float[Array, "height width"]


def tiles(sprites: Sprites, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    value, radius, leak, coc, epsilon = sprites
    planes = _Planes(_stacked(value), radius, leak / epsilon, coc / epsilon)
    return jnp.moveaxis(_sums(reach, planes), 0, -1)


@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sums(reach: int, planes: _Planes) -> Float[Array, "value height width"]:
    return sequential_vmap(ft.partial(_forward, reach))(planes)


@_sums.defjvp
def _sums_jvp(reach, primals, tangents):
    (planes,), (tangent,) = primals, tangents
    push = sequential_vmap(ft.partial(_tangent, reach))
    pull = sequential_vmap(ft.partial(_adjoint, reach))

    def sums(planes):
        value, radius, leak, coc = planes
        one = jnp.ones((), radius.dtype)
        return _stacked(
            shift(Sprites(jnp.moveaxis(value, 0, -1), radius, leak, coc, one), reach)
        )

    # The tangent is linear, S say, and its transpose a kernel of its own. JAX is told so by the
    # one call that takes both and can be mapped, transposed and differentiated: the solve of
    # (u, v - S u) = b, which is (u, v + S u), and for the adjoint (u + S^T v, v). The system
    # itself is wanted by second derivatives only, and may be slow: there S is that of `shift`.
    def matvec(b):
        return b[0], b[1] - jax.jvp(sums, (planes,), (b[0],))[1]

    def solve(_, b):
        return b[0], b[1] + push(planes, b[0])

    def solve_transposed(_, b):
        return jax.tree.map(jnp.add, b[0], pull(planes, b[1])), b[1]

    # It is transposed in the whole of b: what has no tangent borrows a zero from what has.
    leaves = jax.tree.leaves(tangent)
    zero = sum(jnp.where(False, leaf.ravel()[0], 0) for leaf in leaves)
    b = jax.tree.map(lambda x: x + zero, (tangent, jnp.zeros_like(planes.value)))
    _, out = jax.lax.custom_linear_solve(matvec, b, solve, solve_transposed)
    return _sums(reach, planes), out


def _stacked(value: Float[Array, "height width value"]) -> Float[Array, "value height width"]:
    return jnp.moveaxis(value, -1, 0)


def _forward(reach: int, planes: _Planes) -> Float[Array, "value height width"]:
    value, radius, leak, coc = planes

    def tap(cover, own, other):
        coc, sharp = own
        value, leak = other
        weight = cover * (1 - sharp * _clip(leak - coc))
        return [weight[None] * value]

    own, other = [coc, 1 - clip01(coc - 1)], [value, leak]
    (sums,) = _sweep(tap, reach, radius, own, other, by_source=False, slopes=False)
    return sums


def _tangent(reach: int, planes: _Planes, dot: _Planes) -> Float[Array, "value height width"]:
    value, radius, leak, coc = planes

    def tap(cover, slope, own, other):
        coc, coc_dot, sharp, blurring = own
        value, value_dot, leak, leak_dot, radius_dot = other
        rise = leak - coc
        weight = 1 - sharp * _clip(rise)
        weight_dot = sharp * _inside(rise) * (coc_dot - leak_dot)
        weight_dot = weight_dot + blurring * coc_dot * _clip(rise)
        product_dot = slope * radius_dot * weight + cover * weight_dot
        return [product_dot[None] * value + (cover * weight)[None] * value_dot]

    own = [coc, dot.coc, 1 - clip01(coc - 1), _inside(coc - 1)]
    other = [value, dot.value, leak, dot.leak, dot.radius]
    (sums,) = _sweep(tap, reach, radius, own, other, by_source=False, slopes=True)
    return sums


def _adjoint(reach: int, planes: _Planes, bar: Float[Array, "value height width"]) -> _Planes:
    value, radius, leak, coc = planes
    sharp, blurring = 1 - clip01(coc - 1), _inside(coc - 1)

    def to_source(cover, slope, own, other):
        value, leak = own
        bar, coc, sharp = other
        rise = leak - coc
        weight = 1 - sharp * _clip(rise)
        product = sum(x * y for x, y in zip(value, bar, strict=True))
        leak_bar = -cover * sharp * _inside(rise) * product
        return [(cover * weight)[None] * bar, slope * weight * product, leak_bar]

    def to_destination(cover, own, other):
        bar, coc, sharp, blurring = own
        value, leak = other
        rise = leak - coc
        product = sum(x * y for x, y in zip(value, bar, strict=True))
        return [cover * (sharp * _inside(rise) + blurring * _clip(rise)) * product]

    own, other = [value, leak], [bar, coc, sharp]
    value_bar, radius_bar, leak_bar = _sweep(
        to_source, reach, radius, own, other, by_source=True, slopes=True
    )
    own, other = [bar, coc, sharp, blurring], [value, leak]
    (coc_bar,) = _sweep(
        to_destination, reach, radius, own, other, by_source=False, slopes=False
    )
    return _Planes(value_bar, radius_bar, leak_bar, coc_bar)


def _clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Clamp to [0, 1], by comparisons that compile to one instruction each."""
    x = jnp.where(x > 0, x, 0)
    return jnp.where(x < 1, x, 1)


def _inside(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The derivative of `_clip`, at its kinks the one from above."""
    return ((x >= 0) & (x < 1)).astype(x.dtype)


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
    """For every pixel, the sums of `tap(cover, slope, own, other)` over the offsets about it.

    `own` are the planes at the pixel and `other` those at the offset, one or a stack of them.
    The sprite is the pixel's own where `by_source`, else the other's; `cover` is its coverage
    at the offset and `slope`, given where `slopes` are asked for, that coverage's derivative in
    its radius. `tap` gives planes or stacks of them, and their sums come back.
    """
    height, width = radius.shape
    tall, wide = min(TILE[0], -(-height // 8) * 8), min(TILE[1], -(-width // 8) * 8)
    rows, columns = -(-height // tall), -(-width // wide)
    most = max(LEAST_HALO, reach)
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
            upper = _integral(sprite, row.astype(sprite.dtype) + 0.5, slopes)
            widths = [x - y for x, y in zip(upper, lower, strict=True)]

            def add_side(side, sums):
                shift = ft.partial(_rows, start=halo + (1 - 2 * side) * row, size=tall)
                there = [*map(shift, theirs)]
                spans = widths if by_source else [*map(shift, widths)]
                for column in range(-halo, halo + 1):
                    at = slice(halo + column, halo + column + wide)
                    span = spans if by_source else [x[:, at] for x in spans]
                    taps = tap(*_cover(span, column), mine, [x[..., at] for x in there])
                    sums = [x + y for x, y in zip(sums, taps, strict=True)]
                return sums

            # The middle row is its own mirror image.
            return jax.lax.fori_loop(0, jnp.where(row > 0, 2, 1), add_side, sums), upper

        nothing = [jnp.zeros((tall, wide), sprite.dtype)] * (2 if slopes else 1)
        shapes = jax.eval_shape(tap, *nothing, mine, [x[..., :tall, :wide] for x in theirs])
        sums = [jnp.zeros(x.shape, x.dtype) for x in shapes]
        lower = [-x for x in _integral(sprite, jnp.asarray(0.5, sprite.dtype), slopes)]
        return jax.lax.fori_loop(0, reaches[index] + 1, add_row, (sums, lower))[0]

    doubled = takewhile(lambda halo: halo < most, (LEAST_HALO << n for n in count()))
    halos = [0, *doubled, most]
    branches = [ft.partial(tile, halo) for halo in halos]

    def one(index):
        fitting = jnp.searchsorted(jnp.asarray(halos), reaches[index])
        return jax.lax.switch(fitting, branches, index)

    def assembled(tiles):
        tiles = tiles.reshape(rows, columns, -1, tall, wide).transpose(2, 0, 3, 1, 4)
        return tiles.reshape(-1, rows * tall, columns * wide)[:, :height, :width]

    sums = jax.lax.map(one, jnp.arange(rows * columns))
    return [assembled(x) if x.ndim == 4 else assembled(x)[0] for x in sums]


def _rows(planes: Array, start: Array, size: int) -> Array:
    return jax.lax.dynamic_slice_in_dim(planes, start, size, axis=-2)


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


def _cover(span: list[Array], column: int) -> list[Float[Array, "*shape"]]:
    """`_sprites.coverage` for a static column and, given its half-width's, its derivative."""
    width, *width_dot = span
    if column == 0:
        return [_clip(2 * width), *(2 * _inside(2 * width) * x for x in width_dot)]
    edge = width + (0.5 - abs(column))
    return [_clip(edge), *(_inside(edge) * x for x in width_dot)]


@ft.cache
def _segment_polynomial(degree: int) -> tuple[float, ...]:
    """P, lowest power first, in `area(s) = pi / 4 - (1 - s)**1.5 P(s)` for s in [0, 1].

    `area` is the integral of `sqrt(1 - s**2)` from 0. P is analytic but for a branch point at
    -1, so that its Chebyshev series falls by a factor of 5.8 a term.
    """
    nodes = (1 - np.cos(np.pi * (np.arange(4 * degree) + 0.5) / (4 * degree))) / 2
    area = (nodes * np.sqrt(1 - nodes**2) + np.arcsin(nodes)) / 2
    values = (np.pi / 4 - area) / (1 - nodes) ** 1.5
    series = np.polynomial.Chebyshev.fit(nodes, values, degree, domain=(0, 1))
    return tuple(map(float, series.convert(kind=np.polynomial.Polynomial).coef))


def _integral(
    radius: Float[Array, "*shape"], height: Float[Array, ""], slope: bool
) -> list[Float[Array, "*shape"]]:
    """The integral of `sqrt(radius**2 - t**2)` from 0 to `height`, and its slope."""
    s = height / radius
    s = jnp.where(s < 1, s, 1)
    polynomial = jnp.zeros_like(s)
    for coefficient in reversed(_segment_polynomial(9 if s.dtype == jnp.float32 else 18)):
        polynomial = polynomial * s + coefficient
    short = 1 - s
    root = jnp.sqrt(short)
    area = math.pi / 4 - short * root * polynomial
    value = radius * radius * area
    return [value, radius * (2 * area - s * root * jnp.sqrt(1 + s))] if slope else [value]
