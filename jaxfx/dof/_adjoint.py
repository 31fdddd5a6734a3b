"""Kernels whose loops JAX can't transpose, with a tangent and an adjoint of their own."""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array

from jaxfx._linear import linear


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

        def derivative(dot):
            return jax.jvp(ft.partial(plain, reach), (planes,), (dot,))[1]

        out = linear(ft.partial(push, planes), ft.partial(pull, planes), derivative, dot)
        return kernel(reach, planes), out

    return kernel
