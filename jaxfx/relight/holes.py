"""The holes of a synthesized cache."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from jaxfx._arguments import check_gbuffer
from jaxfx._checks import as_array
from jaxfx.gbuffer import GBuffer


_FAR = 1 << 14  # pixels; its square is still an int32, and no picture is as wide


def fill_holes(
    gbuffer: GBuffer, coverage: Int[ArrayLike, "height width"]
) -> tuple[GBuffer, Int[Array, ""]]:
    """What `synthesize` left open, taken from the nearest pixel that a cache covers.

    Pixels without a depth (inf, or missing: 0, negative, NaN) stay as they are.

    **Arguments:** `gbuffer`, `coverage`: height width, both from `synthesize`.

    **Returns:** the `GBuffer`, which keeps its depth; and the number of pixels filled, an
    integer. Where no pixel at all is covered, nothing is filled and the number is 0.

    **Raises:** `ValueError` for a `coverage` of another shape.

    **Gradient:** exact: a filled pixel's is that of the one that it was taken from.

    Source: Kim, Lee & Kyung leave the holes' filling open; the nearest pixel is found as by
    Saito & Toriwaki 1994, columns first.
    """
    gbuffer = check_gbuffer("fill_holes(gbuffer)", gbuffer)
    coverage = as_array("fill_holes(coverage)", coverage)
    if coverage.shape != gbuffer.depth.shape:
        raise ValueError(
            f"`fill_holes(coverage)` must have the cache's height and width "
            f"{gbuffer.depth.shape}, got {coverage.shape}."
        )
    return _fill(gbuffer, coverage)


@jax.jit
def _fill(gbuffer, coverage):
    covered = coverage > 0
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

    First along the columns. Then across, a column farther on either side at a time, for as
    long as some hole could still gain: holes are narrow. All of it is of integers, which no
    derivative passes through.
    """
    height, width = covered.shape
    row = jnp.broadcast_to(jnp.arange(height, dtype=jnp.int32)[:, None], covered.shape)
    above = jax.lax.cummax(jnp.where(covered, row, -_FAR))
    below = jax.lax.cummin(jnp.where(covered, row, 2 * _FAR), reverse=True)
    nearer = jnp.where(row - above <= below - row, above, below)
    apart = jnp.minimum(jnp.abs(nearer - row), _FAR)
    padding = ((0, 0), (width, width))
    squares = jnp.pad(apart**2, padding, constant_values=_FAR**2)
    rows = jnp.pad(jnp.clip(nearer, 0, height - 1), padding)

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

    first = (jnp.int32(0), jnp.full_like(row, _FAR**2), jnp.zeros_like(row))
    _, best, index = jax.lax.while_loop(is_open, widen, first)
    return best < _FAR**2, index
