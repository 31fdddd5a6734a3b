"""Sums over all taps of a window, as one loop inside one kernel, for accelerators.

`windows` gives every element its window by arithmetic on indices, and `summed` adds terms that
are made of such windows. XLA for a GPU then makes one loop of both, whose sums stay in
registers: it takes a moment to compile, however many taps there are, and nothing but the sums
is written to memory.

XLA does so where it reckons that this is quicker than to keep what several sums share. It takes
each array that is summed to compute all that it depends on by itself. Hence two planes make one
complex array, no more than `AT_ONCE` planes are summed at once, and what is long to compute is
kept in memory before. See `docs/design/xla.md`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Shaped


# Planes that are summed at once. With more, XLA keeps the weight of every tap in memory.
AT_ONCE = 4


def windows(x: Shaped[Array, "..."], axis: int, count: int) -> Shaped[Array, "..."]:
    """`count` shifted views of an axis, along a new axis before it.

    Element `i` of view `k` is element `i + k`; the last view ends with the axis.
    """
    axis = axis % x.ndim
    x = jnp.moveaxis(x, axis, -1)
    *outer, size = x.shape
    repeated = jnp.broadcast_to(x[..., None, :], (*outer, count + 1, size))
    # Cut into rows of one element more, each begins one element later.
    rows = repeated.reshape(*outer, -1)[..., : count * (size + 1)]
    views = rows.reshape(*outer, count, size + 1)[..., : size + 1 - count]
    return jnp.moveaxis(views, (-2, -1), (axis, axis + 1))


def summed(
    terms: list[Float[Array, "..."]],
    axes: tuple[int, ...],
    factor: Float[Array, "..."] | None = None,
) -> list[Float[Array, "..."]]:
    """The sum of each of some arrays of one shape over these axes, the first of even length.

    `factor` multiplies every term; what takes long to compute is then computed once for two.
    """
    paired = len(terms) // 2 * 2
    arrays = [*map(jax.lax.complex, terms[:paired:2], terms[1:paired:2]), *terms[paired:]]
    if factor is not None:
        arrays = [x * factor.astype(x.dtype) for x in arrays]
    if len(arrays) == 1:
        # The sum of a single array XLA would cut in two, one after the other.
        first, second = _summed(jnp.split(arrays[0], 2, axes[0]), axes)
        sums = [first + second]
    else:
        sums = _summed(arrays, axes)
    pairs = sums[: paired // 2]
    return [part for x in pairs for part in (x.real, x.imag)] + sums[len(pairs) :]


@ft.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _summed(terms, axes):
    zeros = [jnp.zeros((), x.dtype) for x in terms]
    return jax.lax.reduce(terms, zeros, lambda x, y: [*map(jnp.add, x, y)], axes)


@_summed.defjvp
def _(axes, primals, tangents):
    return _summed(*primals, axes), _summed(*tangents, axes)


def in_turns(offsets: int, most: int) -> tuple[int, int]:
    """In how many turns offsets are visited, and how many in each: an even number."""
    turns = -(-offsets // most)
    return turns, -(-offsets // (2 * turns)) * 2


def together(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function(static, *operands)` for which all arrays have the axis of a batch, or none.

    What is the same for all members of a batch XLA would keep in memory, for every tap.
    """
    return lambda static, *operands: function(static, *_together(*operands))


@custom_vmap
def _together(*operands):
    return operands


@_together.def_vmap
def _(size, is_batched, *operands):
    leaves, tree = jax.tree.flatten(operands)
    leaves = [
        x if has_axis else jnp.broadcast_to(x, (size, *x.shape))
        for has_axis, x in zip(jax.tree.leaves(is_batched), leaves, strict=True)
    ]
    # The barrier keeps XLA from seeing that they are the same.
    found = jax.tree.unflatten(tree, jax.lax.optimization_barrier(leaves))
    return found, jax.tree.map(lambda _: True, found)
