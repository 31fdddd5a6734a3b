"""Kernels whose loops JAX can't transpose, with a tangent and an adjoint of their own."""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array


Planes = TypeVar("Planes", bound=Any)


def with_adjoint(
    forward: Callable[[int, Planes], Array],
    tangent: Callable[[int, Planes, Planes], Array],
    adjoint: Callable[[int, Planes, Array], Planes],
    plain: Callable[[int, Planes], Array],
) -> Callable[[int, Planes], Array]:
    """`forward(reach, planes)`, to be mapped and differentiated, in both modes and again.

    - `planes`: sprites as a named tuple of arrays, in which `value` has the result's shape.
    - `tangent(reach, planes, dot)`: its derivative along `dot`.
    - `adjoint(reach, planes, bar)`: the transpose of that.
    - `plain(reach, planes)`: the same function as JAX itself can differentiate it. Second
      derivatives take theirs from it.

    A batch is worked through one by one, so that it costs what its members do.
    """

    @ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
    def kernel(reach: int, planes: Planes) -> Array:
        return sequential_vmap(ft.partial(forward, reach))(planes)

    @kernel.defjvp
    def _(reach: int, primals: Any, tangents: Any) -> tuple[Array, Array]:
        (planes,), (dot,) = primals, tangents
        push = sequential_vmap(ft.partial(tangent, reach))
        pull = sequential_vmap(ft.partial(adjoint, reach))

        # The tangent is linear, S say, and its transpose a kernel of its own. JAX is told so by
        # the one call that takes both and can be mapped, transposed and differentiated: the
        # solve of (u, v - S u) = b, which is (u, v + S u), and for the adjoint (u + S^T v, v).
        # The system itself is wanted by second derivatives only, and may be slow.
        def matvec(b):
            return b[0], b[1] - jax.jvp(ft.partial(plain, reach), (planes,), (b[0],))[1]

        def solve(_, b):
            return b[0], b[1] + push(planes, b[0])

        def solve_transposed(_, b):
            return jax.tree.map(jnp.add, b[0], pull(planes, b[1])), b[1]

        # It is transposed in the whole of b: what has no tangent borrows a zero from what has.
        zero = sum(jnp.where(False, leaf.ravel()[0], 0) for leaf in jax.tree.leaves(dot))
        b = jax.tree.map(lambda x: x + zero, (dot, jnp.zeros_like(planes.value)))
        _, out = jax.lax.custom_linear_solve(matvec, b, solve, solve_transposed)
        return kernel(reach, planes), out

    return kernel
