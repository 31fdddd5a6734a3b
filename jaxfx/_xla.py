"""Workarounds for what XLA does to sums over taps and planes on a CPU.

Each function computes what its plain form computes, and says which release was seen to be slow
without it. `python -m benchmarks.xla` times both forms on the installed release: what no longer
differs can go. All that was seen, beyond these functions, is in `docs/design/xla.md`.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxfx._loops import cond
from jaxfx._platform import by_platform


# Terms per sum of `added_in_groups`. A term reads two taps, and from 17 reads on XLA makes a
# copy of the image for each.
_GROUP = 8


def apart(array: Array, compute: Callable[[], Any]) -> Any:
    """The result of `compute`, kept in memory, so that its readers do not compute it again.

    XLA:CPU fuses what leads to a value into each reader: nine shifted reads of an `exp` compute
    nine of them. jaxlib 0.10 drops `optimization_barrier` before it fuses; 0.12 keeps it. So
    the value comes from a branch that is always taken, for which an accelerator would have to
    wait. `array` is any float array of the program: the predicate reads its first element, and
    holds for a NaN too.
    """
    first = array.reshape(-1)[0]
    branch = lambda: stored((first >= -jnp.inf) | jnp.isnan(first), compute)
    return by_platform(cpu=branch, accelerator=lambda: lax.optimization_barrier(compute()))


def stored(is_needed: Bool[Array, ""], compute: Callable[..., Any], *operands: Any) -> Any:
    """`compute(*operands)` in memory if `is_needed`, else zeros.

    XLA fuses nothing across a `cond` whose predicate it does not know.
    """
    shapes = jax.eval_shape(compute, *operands)
    nothing = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return cond(is_needed, compute, nothing, *operands)


def added(terms: list[Callable[[], Array]]) -> Array:
    """The sum of the terms."""
    return ft.reduce(jnp.add, [term() for term in terms])


def added_in_groups(image: Array, terms: list[Callable[[], Array]]) -> Array:
    """The sum of the terms, some at a time; `image` as in `apart`.

    Of more than 16 shifted reads in one sum, XLA:CPU of jaxlib 0.10 and 0.12 makes as many
    copies of the image.
    """
    groups = [terms[i : i + _GROUP] for i in range(0, len(terms), _GROUP)]
    if len(groups) == 1:
        return added(terms)
    return ft.reduce(jnp.add, [apart(image, ft.partial(added, group)) for group in groups])


def sum_planes(planes: Float[Array, "..."], axis: int = 0) -> Float[Array, "..."]:
    """The sum over a short axis, plane by plane.

    XLA:CPU of jaxlib 0.12 takes ten times as long to sum over a last axis of three numbers. The
    transpose of a broadcast over such an axis is that sum.
    """
    return ft.reduce(jnp.add, jnp.moveaxis(planes, axis, 0))
