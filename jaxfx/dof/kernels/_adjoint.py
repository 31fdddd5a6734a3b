"""Kernels whose loops JAX can't transpose, with a tangent and an adjoint of their own."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfx._linear import linear
from jaxfx._loops import varying_as
from jaxfx._platform import of_directions, one_by_one_on_cpu


Planes = TypeVar("Planes", bound=Any)


class Program(NamedTuple):
    """A program for a kernel: functions of the static reach of sprites and of planes.

    - `forward(reach, planes)`: the sums.
    - `tangents(reach, planes, dots)`: their derivatives along several directions at once. The
      first axis of `dots`, and of the result, is that of the directions.
    - `adjoint(reach, planes, bar)`: the transpose of the derivative, at one cotangent.
    - `recorded(reach, planes)`: the sums and a record of them, arrays of floats, which
      `adjoint` then takes as a fourth argument. None where it needs no record.
    """

    forward: Callable[[Any, Any], Array]
    tangents: Callable[[Any, Any, Any], Array]
    adjoint: Callable[..., Any]
    recorded: Callable[[Any, Any], tuple[Array, Any]] | None = None


def with_adjoint(
    cpu: Program, plain: Callable[[Any, Planes], Array], accelerator: Program | None = None
) -> Callable[[Any, Planes], Array]:
    """`cpu.forward(reach, planes)`, to be mapped and differentiated, in both modes and again.

    - `reach`: static; how far sprites reach, in pixels or as the kernel states it.
    - `planes`: sprites as a named tuple of arrays, in which `value` has the result's shape.
    - `plain(reach, planes)`: the same function as JAX itself can differentiate it. Second
      derivatives take theirs from it.
    - `accelerator`: the program where it is lowered for something else than a CPU; the same if
      it is left out. Both record, or neither.

    On a CPU a batch is worked through one by one, so that it costs what its members do.
    """

    def mapped(*programs):
        # Compiled, so that they are traced once, however often a transform comes back to them.
        programs = [jax.jit(each, static_argnums=0) for each in dict.fromkeys(programs)]

        def call(reach, *operands):
            return one_by_one_on_cpu(*(ft.partial(each, reach) for each in programs))(*operands)

        return call

    programs = cpu, accelerator or cpu
    both: list[Any] = [
        None if parts[0] is None else mapped(*parts) for parts in zip(*programs, strict=True)
    ]
    forward, tangents, adjoint, recorded = both

    @ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
    def kernel(reach: Any, planes: Planes) -> Array:
        return forward(reach, planes)

    @ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
    def with_record(reach: Any, planes: Planes) -> tuple[Array, Any]:
        return (kernel(reach, planes), ()) if recorded is None else recorded(reach, planes)

    def value_and_tangent(reach, planes, dot):
        out, record = with_record(reach, planes)
        of_all = of_directions(ft.partial(tangents, reach))

        def push(dot):
            return of_all(planes, jax.tree.map(lambda x: x[None], dot))[0]

        def pull(bar):
            return adjoint(reach, planes, bar, *(() if recorded is None else (record,)))

        def derivative(dot):
            return jax.jvp(ft.partial(plain, reach), (planes,), (dot,))[1]

        return (out, record), linear(push, pull, derivative, dot)

    @kernel.defjvp
    def _(reach: Any, primals: Any, tangents: Any) -> tuple[Array, Array]:
        (out, _), out_dot = value_and_tangent(reach, *primals, *tangents)
        return out, out_dot

    @with_record.defjvp
    def _(reach: Any, primals: Any, tangents: Any) -> tuple[Any, Any]:
        (out, record), out_dot = value_and_tangent(reach, *primals, *tangents)
        # What the record has to do with the planes, `derivative` knows.
        zeros = varying_as(record, jax.tree.map(jnp.zeros_like, record))
        return (out, record), (out_dot, zeros)

    return kernel
