"""Sums over all taps of a window, as one loop inside one kernel, for accelerators.

`windows` gives every element its window by arithmetic on indices, and `summed` adds up a term
of such windows. XLA for a GPU makes one loop of both, whose sums stay in registers: it takes a
moment to compile, however many taps there are, and nothing but the sums is written to memory.

What several sums share, as the coverage of a tap, XLA would compute for each of them, or keep
in memory for every tap, as it reckons: above some size of an image, it keeps. So `summed` has
the term inside the addition of its one reduction, where XLA sees nothing that is shared. See
`docs/design/xla.md`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Shaped


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
    term: Callable[..., Any], inputs: tuple[Any, ...], axes: tuple[int, ...]
) -> list[Float[Array, "..."]]:
    """The sums of `term(*inputs)` over these axes, one for each number that it gives.

    `inputs` are trees of arrays of one dtype that broadcast together; `term` is given one
    element of each. A plane of memory is taken for each input or each sum, whichever are more:
    what is used once is better computed before.
    """
    leaves, tree = jax.tree.flatten(inputs)
    shape = jnp.broadcast_shapes(*(x.shape for x in leaves))
    of_leaves = lambda *leaves: jax.tree.leaves(term(*jax.tree.unflatten(tree, leaves)))
    return _summed([jnp.broadcast_to(x, shape) for x in leaves], of_leaves, axes)


@ft.partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def _summed(leaves, term, axes):
    """What is added is a flag and some numbers: the inputs of a term, or sums of terms."""
    dtype = leaves[0].dtype
    count = len(jax.eval_shape(term, *[jax.ShapeDtypeStruct((), dtype)] * len(leaves)))
    numbers = leaves + [jnp.zeros_like(leaves[0])] * (count - len(leaves))

    def sums_of(is_term, *numbers):
        terms = term(*numbers[: len(leaves)])
        return [jnp.where(is_term, *pair) for pair in zip(terms, numbers[:count], strict=True)]

    def add(one, other):
        sums = [*map(jnp.add, sums_of(*one), sums_of(*other))]
        # Constants, as where the loop begins: so XLA sees that its sums are never a term.
        return [jnp.zeros((), bool), *sums, *[jnp.zeros((), dtype)] * (len(numbers) - count)]

    operands = [jnp.ones_like(leaves[0], bool), *numbers]
    nothing = [jnp.zeros((), x.dtype) for x in operands]
    return jax.lax.reduce(operands, nothing, add, axes)[1 : 1 + count]


@_summed.defjvp
def _(term, axes, primals, tangents):
    (leaves,), (dots,) = primals, tangents
    count = len(leaves)
    tangent = lambda *both: jax.jvp(term, both[:count], both[count:])[1]
    return _summed(leaves, term, axes), _summed([*leaves, *dots], tangent, axes)


def in_turns(offsets: int, most: int) -> tuple[int, int]:
    """In how many turns offsets are visited, and how many in each."""
    turns = -(-offsets // most)
    return turns, -(-offsets // turns)


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
