"""Kernels whose loops JAX can't transpose, with a tangent and an adjoint of their own."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
from jaxtyping import Array

from jaxfx._linear import linear
from jaxfx._platform import one_by_one_on_cpu


Planes = TypeVar("Planes", bound=Any)


class Program(NamedTuple):
    """A program for a kernel: functions of the static reach of sprites and of planes."""

    forward: Callable[[Any, Any], Array]
    tangent: Callable[[Any, Any, Any], Array]
    adjoint: Callable[[Any, Any, Array], Any]


def with_adjoint(
    forward: Callable[[Any, Planes], Array],
    tangent: Callable[[Any, Planes, Planes], Array],
    adjoint: Callable[[Any, Planes, Array], Planes],
    plain: Callable[[Any, Planes], Array],
    accelerator: Program | None = None,
) -> Callable[[Any, Planes], Array]:
    """`forward(reach, planes)`, to be mapped and differentiated, in both modes and again.

    - `reach`: static; how far sprites reach, in pixels or as the kernel states it.
    - `planes`: sprites as a named tuple of arrays, in which `value` has the result's shape.
    - `tangent(reach, planes, dot)`: its derivative along `dot`.
    - `adjoint(reach, planes, bar)`: the transpose of that.
    - `plain(reach, planes)`: the same function as JAX itself can differentiate it. Second
      derivatives take theirs from it.
    - `accelerator`: the first three where the program is lowered for something else than a CPU;
      the same if it is left out.

    On a CPU a batch is worked through one by one, so that it costs what its members do.
    """

    def mapped(*programs):
        # Compiled, so that they are traced once, however often a transform comes back to them.
        programs = [jax.jit(each, static_argnums=0) for each in dict.fromkeys(programs)]

        def call(reach, *operands):
            return one_by_one_on_cpu(*(ft.partial(each, reach) for each in programs))(*operands)

        return call

    cpu = forward, tangent, adjoint
    forward, tangent, adjoint = map(mapped, cpu, accelerator or cpu)

    @ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
    def kernel(reach: Any, planes: Planes) -> Array:
        return forward(reach, planes)

    @kernel.defjvp
    def _(reach: Any, primals: Any, tangents: Any) -> tuple[Array, Array]:
        (planes,), (dot,) = primals, tangents
        push = ft.partial(tangent, reach, planes)
        pull = ft.partial(adjoint, reach, planes)

        def derivative(dot):
            return jax.jvp(ft.partial(plain, reach), (planes,), (dot,))[1]

        return kernel(reach, planes), linear(push, pull, derivative, dot)

    return kernel
