"""Linear functions whose transpose is a program of its own."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def linear(
    push: Callable[[Any], Any],
    pull: Callable[[Any], Any],
    plain: Callable[[Any], Any],
    x: Any,
) -> Any:
    """`push(x)`, of which JAX is told that its transpose is `pull`.

    - `push`, `pull`: a linear function and its transpose, by any program.
    - `plain`: the same function as `push`, as JAX itself can differentiate it in what it closes
      over. Only that asks for it.

    The one call of JAX that takes a transpose and can itself be mapped, transposed and
    differentiated is a linear solve: that of `(u, v - push(u)) = (x, 0)`, which is
    `(x, push(x))`; and for the transpose, of `(x, y)`, that is `(x + pull(y), y)`.
    """

    def matvec(b):
        return b[0], jax.tree.map(jnp.subtract, b[1], plain(b[0]))

    def solve(_, b):
        return b[0], jax.tree.map(jnp.add, b[1], push(b[0]))

    def solve_transposed(_, b):
        return jax.tree.map(jnp.add, b[0], pull(b[1])), b[1]

    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(plain, x))
    # It is transposed in the whole of both pairs: what has no tangent, or no cotangent, borrows
    # a zero from what has.
    b = _with_zero_from(x, (x, zeros))
    solved: Any = jax.lax.custom_linear_solve(matvec, b, solve, solve_transposed)
    return _with_zero_from(*solved)


def _with_zero_from(source: Any, tree: Any) -> Any:
    zero = sum(jnp.where(False, leaf.ravel()[0], 0) for leaf in jax.tree.leaves(source))
    return jax.tree.map(lambda leaf: leaf + zero, tree)
