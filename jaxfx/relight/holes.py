"""The holes of a synthesized cache."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from jaxfx._arguments import check_gbuffer
from jaxfx._checks import as_array
from jaxfx._platform import by_platform
from jaxfx.gbuffer import GBuffer


_FAR = 1 << 14  # pixels; its square is still an int32, and no picture is as wide
_NEAR = 32  # columns; few holes are wider on both sides

_Mask = Bool[Array, "height width"]
_Numbers = Int[Array, "height width"]


def fill_holes(
    gbuffer: GBuffer, views: Int[ArrayLike, "height width"]
) -> tuple[GBuffer, Int[Array, ""]]:
    """What `synthesize` left open, taken from the nearest pixel that a cache covers.

    Pixels without a depth (inf, or missing: 0, negative, NaN) stay as they are.

    **Arguments:** `gbuffer`, `views`: height width, integers; both from `synthesize`.

    **Returns:** the `GBuffer`, which keeps its depth; and the number of pixels filled, an
    integer. Where no pixel at all is covered, nothing is filled and the number is 0.

    **Raises:** `ValueError` for a `views` of another shape.

    **Gradient:** exact: a filled pixel's is that of the one that it was taken from.

    Source: Kim, Lee & Kyung leave the holes' filling open; the nearest pixel is found as by
    Saito & Toriwaki 1994, columns first.
    """
    gbuffer = check_gbuffer("fill_holes(gbuffer)", gbuffer)
    views = as_array("fill_holes(views)", views)
    if views.shape != gbuffer.depth.shape:
        raise ValueError(
            f"`fill_holes(views)` must have the cache's height and width "
            f"{gbuffer.depth.shape}, got {views.shape}."
        )
    return _fill(gbuffer, views)


@jax.jit
def _fill(gbuffer, views):
    covered = views > 0
    hole = ~covered & jnp.isfinite(gbuffer.depth) & (gbuffer.depth > 0)
    found, near = _nearest(covered, hole)
    hole &= found
    height, width = covered.shape

    def filled(field):
        taken = field.reshape(height * width, *field.shape[2:])[near]
        return jnp.where(hole.reshape(hole.shape + (1,) * (field.ndim - 2)), taken, field)

    fields = {name: filled(value) for name, value in vars(gbuffer).items() if name != "depth"}
    return GBuffer(depth=gbuffer.depth, **fields), jnp.sum(hole, dtype=jnp.int32)


def _nearest(
    covered: Bool[Array, "height width"], hole: Bool[Array, "height width"]
) -> tuple[Bool[Array, "height width"], Int[Array, "height width"]]:
    """Whether anything is covered, and the flat index of the nearest such pixel to each hole.

    First along the columns. Then across, for as far as some hole could still gain: holes are
    narrow. All of it is of integers, which no derivative passes through.
    """
    height = len(covered)
    row = jnp.broadcast_to(jnp.arange(height, dtype=jnp.int32)[:, None], covered.shape)
    above = jax.lax.cummax(jnp.where(covered, row, -_FAR))
    below = jax.lax.cummin(jnp.where(covered, row, 2 * _FAR), reverse=True)
    nearer = jnp.where(row - above <= below - row, above, below)
    apart = jnp.minimum(jnp.abs(nearer - row), _FAR)
    planes = apart**2, jnp.clip(nearer, 0, height - 1), hole
    best, index = by_platform(*planes, cpu=_widening, accelerator=_in_two_passes)
    return best < _FAR**2, index


def _widening(squares: _Numbers, rows: _Numbers, hole: _Mask) -> tuple[_Numbers, _Numbers]:
    """The least squared distance and its pixel, a column farther on either side at a time."""
    width = squares.shape[1]
    padding = ((0, 0), (width, width))
    squares = jnp.pad(squares, padding, constant_values=_FAR**2)
    rows = jnp.pad(rows, padding)

    def is_open(state):
        reach, best, _ = state
        return (reach < width) & jnp.any(hole & (reach * reach < best))

    def widen(state):
        reach, best, index = state
        for start in (width - reach, width + reach):
            cut = lambda image, start=start: jax.lax.dynamic_slice_in_dim(
                image, start, width, 1
            )
            squared = cut(squares) + reach * reach
            column = jnp.arange(width, dtype=jnp.int32)[None] + (start - width)
            index = jnp.where(squared < best, cut(rows) * width + column, index)
            best = jnp.minimum(squared, best)
        return reach + 1, best, index

    first = (
        jnp.int32(0),
        jnp.full(hole.shape, _FAR**2, jnp.int32),
        jnp.zeros(hole.shape, jnp.int32),
    )
    return jax.lax.while_loop(is_open, widen, first)[1:]


def _in_two_passes(squares: _Numbers, rows: _Numbers, hole: _Mask) -> tuple[_Numbers, _Numbers]:
    """The same: columns up to `_NEAR` away, and all of them if some hole could still gain."""
    width = squares.shape[1]
    best, column = near = _least(squares, min(_NEAR, width - 1))
    if width - 1 > _NEAR:
        is_open = jnp.any(hole & (best > _NEAR**2))
        everywhere = lambda: _least(squares, width - 1)
        best, column = jax.lax.cond(is_open, everywhere, lambda: near)
    return best, jnp.take_along_axis(rows, column, axis=1) * width + column


def _least(squares: _Numbers, reach: int) -> tuple[_Numbers, _Numbers]:
    """The least squared distance of so many columns to either side, and which is the first.

    Nothing is stored for a column: the minimum is taken as it is computed.
    """
    width = squares.shape[1]
    step = jnp.arange(-reach, reach + 1, dtype=jnp.int32)
    column = jnp.arange(width, dtype=jnp.int32)[:, None] + step[None]
    inside = (column >= 0) & (column < width)
    squared = squares.at[:, jnp.clip(column, 0, width - 1)].get(mode="promise_in_bounds")
    squared = jnp.where(inside[None], squared + (step * step)[None, None], 2 * _FAR**2)
    best = jnp.min(squared, axis=2)
    # Of equal ones the nearer column, then the one to the left.
    rank = 2 * jnp.abs(step) + (step > 0).astype(jnp.int32)
    rank = jnp.min(jnp.where(squared == best[..., None], rank[None, None], 2 * _FAR), axis=2)
    away = jnp.where(rank % 2 == 1, rank // 2, -(rank // 2))
    return best, jnp.arange(width, dtype=jnp.int32)[None] + away
