"""Filling the holes of a synthesized cache."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxfx._arguments import check_gbuffer
from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_array
from jaxfx._loops import cond, while_loop
from jaxfx._meshes import on_any_mesh
from jaxfx._platform import at_once
from jaxfx.gbuffer import GBuffer


# Pixels; the distance that stands for none. It must exceed an image's sides, and twice its
# square must be an int32.
_FAR = 1 << 14
# Columns to either side that an accelerator searches first. Holes are narrow; where one is
# wider, all columns are searched, so this matters for speed alone.
_NEAR_COLUMNS = 32

_Mask = Bool[Array, "height width"]
_Integers = Int[Array, "height width"]


class FilledCache(NamedTuple):
    """A cache whose holes are filled, and how many there were.

    - `gbuffer`: the `GBuffer`, height width; its depth is unchanged.
    - `hole_count`: a scalar integer, the number of pixels that were filled.
    """

    gbuffer: GBuffer
    hole_count: Int[Array, ""]


@on_any_mesh
def fill_holes(gbuffer: GBuffer, views: Int[ArrayLike, "height width"]) -> FilledCache:
    """Fill what `synthesize` left open, each hole from the nearest pixel that a cache shows.

    Pixels without a depth (inf, or missing: 0, negative, NaN) are no holes and stay as they
    are.

    **Arguments:**

    - `gbuffer`: the cache, height width, from `synthesize`.
    - `views`: height width, integers, from `synthesize`: how many caches show each pixel. A
      hole has 0.

    **Returns:** a `FilledCache` of `gbuffer` and `hole_count`. Where no pixel at all is
    covered, nothing is filled and the count is 0.

    **Raises:** `ValueError` for `views` of another shape.

    **Gradient:** exact: a filled pixel's is that of the one that it was copied from.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, relight
    >>> image, shader = jnp.zeros((8, 8, 3)).at[:, 4].set(1), jnp.zeros((8, 8), int)
    >>> depth = jnp.ones((8, 8))
    >>> gbuffer = GBuffer(image, shader, image, image, image, image, depth, depth)
    >>> views = shader.at[:, 4].set(1)  # Only the fifth column is covered.
    >>> filled, hole_count = relight.fill_holes(gbuffer, views)
    >>> int(hole_count), float(filled.color.min())
    (56, 1.0)

    Source: Kim, Lee & Kyung leave the filling open; the nearest pixel is found as by Saito &
    Toriwaki 1994, columns first.
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
    is_covered = views > 0
    is_hole = ~is_covered & jnp.isfinite(gbuffer.depth) & (gbuffer.depth > 0)
    exists, nearest = _nearest_covered(is_covered, is_hole)
    is_hole &= exists
    height, width = is_covered.shape

    def filled(field):
        copied = field.reshape(height * width, *field.shape[2:])[nearest]
        mask = is_hole.reshape(is_hole.shape + (1,) * (field.ndim - 2))
        return jnp.where(mask, copied, field)

    fields = {name: filled(value) for name, value in vars(gbuffer).items() if name != "depth"}
    hole_count = jnp.sum(is_hole, dtype=jnp.int32)
    return FilledCache(GBuffer(depth=gbuffer.depth, **fields), hole_count)


def _nearest_covered(is_covered: _Mask, is_hole: _Mask) -> tuple[_Mask, _Integers]:
    """Whether any pixel is covered, and the flat index of the one nearest to each hole.

    First along the columns, then across them, as far as some hole can still come nearer. All
    numbers are integers, so no derivative passes through.
    """
    height = len(is_covered)
    row = jnp.broadcast_to(jnp.arange(height, dtype=jnp.int32)[:, None], is_covered.shape)
    above = jax.lax.cummax(jnp.where(is_covered, row, -_FAR))
    below = jax.lax.cummin(jnp.where(is_covered, row, 2 * _FAR), reverse=True)
    nearest_row = jnp.where(row - above <= below - row, above, below)
    distance = jnp.minimum(jnp.abs(nearest_row - row), _FAR)
    planes = distance**2, jnp.clip(nearest_row, 0, height - 1), is_hole
    squared, index = at_once(_widening, _in_two_passes)(*planes)
    return squared < _FAR**2, index


def _widening(
    squares: _Integers, rows: _Integers, is_hole: _Mask
) -> tuple[_Integers, _Integers]:
    """The least squared distance to a covered pixel, and its flat index, per pixel.

    `squares` and `rows` are the squared distance and the row of the nearest covered pixel in
    the same column. The loop reads one more column on either side in each iteration.
    """
    width = squares.shape[1]
    padding = ((0, 0), (width, width))
    squares = jnp.pad(squares, padding, constant_values=_FAR**2)
    rows = jnp.pad(rows, padding)

    def is_open(state):
        reach, least, _ = state
        return (reach < width) & jnp.any(is_hole & (reach * reach < least))

    def widen(state):
        reach, least, index = state
        for start in (width - reach, width + reach):
            cut = lambda image, start=start: jax.lax.dynamic_slice_in_dim(
                image, start, width, 1
            )
            squared = cut(squares) + reach * reach
            column = jnp.arange(width, dtype=jnp.int32)[None] + (start - width)
            index = jnp.where(squared < least, cut(rows) * width + column, index)
            least = jnp.minimum(squared, least)
        return reach + 1, least, index

    first = (
        jnp.int32(0),
        jnp.full(is_hole.shape, _FAR**2, jnp.int32),
        jnp.zeros(is_hole.shape, jnp.int32),
    )
    return while_loop(is_open, widen, first)[1:]


def _in_two_passes(
    squares: _Integers, rows: _Integers, is_hole: _Mask
) -> tuple[_Integers, _Integers]:
    """As `_widening`: `_NEAR_COLUMNS` to either side; all columns if a hole is still open."""
    width = squares.shape[1]
    least, column = near = _least_over_columns(squares, min(_NEAR_COLUMNS, width - 1))
    if width - 1 > _NEAR_COLUMNS:
        is_open = jnp.any(is_hole & (least > _NEAR_COLUMNS**2))
        everywhere = lambda: _least_over_columns(squares, width - 1)
        least, column = cond(is_open, everywhere, lambda: near)
    return least, jnp.take_along_axis(rows, column, axis=1) * width + column


def _least_over_columns(squares: _Integers, reach: int) -> tuple[_Integers, _Integers]:
    """The least squared distance within `reach` columns to either side, and its column.

    XLA fuses the distances into the minimum: none is stored.
    """
    width = squares.shape[1]
    step = jnp.arange(-reach, reach + 1, dtype=jnp.int32)
    column = jnp.arange(width, dtype=jnp.int32)[:, None] + step[None]
    is_inside = (column >= 0) & (column < width)
    squared = squares.at[:, jnp.clip(column, 0, width - 1)].get(mode="promise_in_bounds")
    squared = jnp.where(is_inside[None], squared + (step * step)[None, None], 2 * _FAR**2)
    least = jnp.min(squared, axis=2)
    # Of equal distances the nearer column wins, then the one on the left.
    rank = 2 * jnp.abs(step) + (step > 0).astype(jnp.int32)
    rank = jnp.min(jnp.where(squared == least[..., None], rank[None, None], 2 * _FAR), axis=2)
    offset = jnp.where(rank % 2 == 1, rank // 2, -(rank // 2))
    return least, jnp.arange(width, dtype=jnp.int32)[None] + offset
