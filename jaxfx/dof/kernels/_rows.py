"""Scatter as a gather, by rows of offsets, each over the whole image.

For devices on which a launch costs more than what it computes: a turn of the loop adds all taps
of a row, or of several, in a kernel or two. The turns are as many as the largest sprite has
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
from jaxtyping import Array, Float, Num

from jaxfx._loops import fori_loop
from jaxfx.dof.kernels import _taps
from jaxfx.dof.kernels._adjoint import Program
from jaxfx.dof.kernels._taps import Sweep, inside
from jaxfx.dof.sprites import POINT_RADIUS, segment_integral


# The most work of one kernel: taps times planes that are read; and that times sums. With more,
# XLA writes what several sums share to memory, for every tap; chosen by compiling for an H100.
_READS, _COST = 580, 2300


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
    height, width = radius.shape
    own, other = _listed(own), _listed(other)
    covers = [radius] * (2 if slopes else 1)
    shapes = jax.eval_shape(tap, *covers, own, other)
    sums = jax.tree.map(lambda _: jnp.zeros_like(radius), shapes)

    taps = 2 * reach + 1
    reads, added = (len(jax.tree.leaves(x)) for x in ((covers, own, other), sums))
    most = max(1, min(_READS // reads, _COST // (reads * added)))
    run = -(-taps // -(-taps // most))  # taps at a time, of equal runs
    rows = max(1, min(taps, most // (2 * taps)))  # at a time; more are long to compile
    turns = -(-taps // rows)

    def padded(plane, fill=0.0):
        # No sprite reaches the rows that only fill up the last turn.
        below = reach + turns * rows - taps
        return jnp.pad(plane, ((reach, below), (reach, reach)), constant_values=fill)

    there = jax.tree.map(padded, other)
    sprite = radius if by_source else padded(radius, POINT_RADIUS)

    def add_row(index, sums):
        at_row = ft.partial(
            jax.lax.dynamic_slice_in_dim,
            start_index=index,
            slice_size=height,
            allow_negative_indices=False,
        )
        theirs = jax.tree.map(at_row, there)
        widths = _half_widths(sprite, jnp.abs(index - reach), slopes)
        spans = widths if by_source else [*map(at_row, widths)]
        for k in range(taps):
            if k and k % run == 0:
                # Else it would keep what both runs share.
                sums, spans = jax.lax.optimization_barrier((sums, spans))
            at = lambda x, k=k: x[:, k : k + width]
            covers = _covers(k - reach, *(spans if by_source else map(at, spans)))
            sums = jax.tree.map(jnp.add, sums, tap(*covers, own, jax.tree.map(at, theirs)))
        return sums

    def turn(index, sums):
        for row in range(rows):
            sums = add_row(index * rows + row, sums)
        return sums

    sums = fori_loop(0, turns, turn, sums)
    return [jnp.stack(x) if isinstance(x, list) else x for x in sums]


def _listed(planes: list[Array]) -> list[Any]:
    """Stacks as lists of planes: XLA then adds to all of them in one kernel."""
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


def _covers(
    column: int, width: Float[Array, "height width"], *slope: Float[Array, "height width"]
) -> list[Float[Array, "height width"]]:
    """How much of the pixel at `column` is covered and, if it is given, by what slope."""
    passed, factor = (width + (0.5 - abs(column)), 1) if column else (2 * width, 2)
    return [_clip(passed), *(inside(passed) * factor * x for x in slope)]


def _clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Clamp to [0, 1], in one operation: XLA for a GPU takes its time for each of them."""
    return jax.lax.clamp(jnp.zeros((), x.dtype), x, jnp.ones((), x.dtype))


_SWEEP = Sweep(_sums, _clip)
ROWS = Program(
    ft.partial(_taps.forward, _SWEEP),
    ft.partial(_taps.tangent, _SWEEP),
    ft.partial(_taps.adjoint, _SWEEP),
)
