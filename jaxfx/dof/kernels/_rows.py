"""Scatter as a gather, by rows of offsets, each over the whole image.

For devices on which a launch costs more than what it computes: a turn of the loop adds all taps
of several rows in one kernel (`_windows`). The turns are as many as the largest sprite has
rows, which is known when the program is compiled: the host looks at no result. The adjoint is
the same sweep, owned by the sources: no scatter is left.

What it does not do well: every tap of the largest sprite is computed at every pixel, whatever
the image holds.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfx._loops import fori_loop
from jaxfx._platform import one_by_one
from jaxfx.dof.kernels import _taps
from jaxfx.dof.kernels._adjoint import Program
from jaxfx.dof.kernels._taps import Sweep, inside
from jaxfx.dof.kernels._windows import in_turns, summed, together, windows
from jaxfx.dof.sprites import POINT_RADIUS, segment_integral


# The most rows of offsets at a time. More take memory: the half-width of every sprite is kept
# for each of them.
_ROWS = 10


def _sums(
    tap: Callable[..., list[Any]],
    reach: int,
    radius: Float[Array, "height width"],
    own: list[Array],
    other: list[Array],
    *,
    by_source: bool,
    slopes: bool,
) -> list[Array]:
    """`Sweep.sums` of `_taps`, by rows of offsets."""
    height = len(radius)
    own, other = _listed(own), _listed(other)
    shapes = jax.eval_shape(tap, *[radius] * (2 if slopes else 1), own, other)
    planes, tree = jax.tree.flatten(shapes)
    taps = 2 * reach + 1
    turns, rows = in_turns(taps, _ROWS)
    # Of the pixel in the middle both halves are covered.
    column = np.abs(np.arange(taps) - reach)[None, None, :, None]
    factor = jnp.asarray(np.where(column == 0, 2, 1), radius.dtype)
    shift = jnp.asarray(np.where(column == 0, 0, 0.5 - column), radius.dtype)

    def padded(plane, fill=0.0):
        # No sprite reaches the rows that only fill up the last turn.
        below = reach + turns * rows - taps
        return jnp.pad(plane, ((reach, below), (reach, reach)), constant_values=fill)

    there = jax.tree.map(padded, other)
    sprite = radius if by_source else padded(radius, POINT_RADIUS)
    at_pixel = jax.tree.map(lambda x: x[None, :, None], own)

    def turn(index, sums):
        def at_rows(x):
            part = jax.lax.dynamic_slice_in_dim(
                x, index * rows, height + rows - 1, allow_negative_indices=False
            )
            return windows(part, 0, rows)

        row = jnp.abs(index * rows + jnp.arange(rows) - reach)
        half_widths = jax.vmap(
            ft.partial(_half_widths, slopes=slopes), (None if by_source else 0, 0)
        )
        spans = half_widths(sprite if by_source else at_rows(sprite), row)
        # Kept in memory: a reduction would compute it again for every tap.
        spans = jax.lax.optimization_barrier(spans)
        wide = [x[:, :, None] if by_source else windows(x, 2, taps) for x in spans]
        near = jax.tree.map(lambda x: windows(at_rows(x), 2, taps), there)
        inputs = wide, factor, shift, at_pixel, near
        return sums + jnp.stack(summed(term, inputs, (0, 2)))

    def term(wide, factor, shift, own, other):
        passed = factor * wide[0] + shift
        covers = [_clip(passed), *(inside(passed) * factor * x for x in wide[1:])]
        return tap(*covers, own, other)

    nothing = jnp.stack([jnp.zeros_like(radius) for _ in planes])
    sums = jax.tree.unflatten(tree, [*fori_loop(0, turns, turn, nothing)])
    return [jnp.stack(x) if isinstance(x, list) else x for x in sums]


def _listed(planes: list[Array]) -> list[Any]:
    """Stacks as lists of planes: `summed` takes one number of each plane."""
    return [[*x] if x.ndim == 3 else x for x in planes]


def _half_widths(
    radius: Float[Array, "*shape"], row: Num[Array, ""], slopes: bool
) -> list[Float[Array, "*shape"]]:
    """The mean half-width of each disc in a row from the middle one on; with its slope."""
    row = row.astype(radius.dtype)
    upper = segment_integral(radius, row + 0.5, slopes)
    lower = segment_integral(radius, jnp.abs(row - 0.5), slopes)
    sign = jnp.sign(row - 0.5)  # half of the middle row lies below its middle
    return [x - sign * y for x, y in zip(upper, lower, strict=True)]


def _clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Clamp to [0, 1], in one operation: XLA for a GPU takes its time for each of them."""
    return jax.lax.clamp(jnp.zeros((), x.dtype), x, jnp.ones((), x.dtype))


_SWEEP = Sweep(_sums, _clip)
ROWS = Program(
    together(ft.partial(_taps.forward, _SWEEP)),
    one_by_one(together(ft.partial(_taps.tangent, _SWEEP))),
    together(ft.partial(_taps.adjoint, _SWEEP)),
)
