"""Elementwise functions with finite derivatives everywhere, small dense algebra, `one_program`.

Of arrays alone: nothing here knows the package's types or checks arguments.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float


Function = TypeVar("Function", bound=Callable[..., Any])


def one_program(function: Function, *, static_argnums: int | tuple[int, ...] = ()) -> Function:
    """A function of arrays whose operations are compiled together where it is called by itself.

    Outside of `jit` each operation would be compiled alone, some 30 ms each. Inside of another
    program nothing changes: the operations are written into it.
    """
    program: Any = jax.jit(function, static_argnums=static_argnums, inline=True)
    return program


def common_dtype(*dtypes: DTypeLike) -> jnp.dtype:
    """The widest of `dtypes`, by JAX's standard rules, even where promotion is strict."""
    with jax.numpy_dtype_promotion("standard"):
        return jnp.result_type(*dtypes)


def working_dtype(*dtypes: DTypeLike) -> jnp.dtype:
    """The type that images of `dtypes` are computed in: the widest, float32 at least."""
    return common_dtype(*dtypes, jnp.float32)


@jax.custom_jvp
def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose value and derivative are 0 where `x` is 0 or negative.

    It does not use a double `where`: XLA may compute the predicate twice, rounded differently,
    and then select the stand-in for the root.
    """
    return jnp.sqrt(jnp.maximum(x, 0))


@safe_sqrt.defjvp
def _safe_sqrt_jvp(primals, tangents):
    (x,), (x_dot,) = primals, tangents
    root = safe_sqrt(x)
    floor = math.sqrt(jnp.finfo(x.dtype).tiny)  # A second derivative divides by its square.
    return root, root / (2 * jnp.maximum(x, floor)) * x_dot


@one_program
def safe_divide(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x / y`, with value and derivatives 0 where `y` is 0."""
    nonzero = y != 0
    return jnp.where(nonzero, x / jnp.where(nonzero, y, 1), 0)


@one_program
def normalize(vector: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Unit vectors along the last axis; the zero vector stays zero, with zero derivative."""
    length = safe_sqrt(jnp.sum(vector * vector, axis=-1, keepdims=True))
    return safe_divide(vector, length)


@one_program
def inverse(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The inverse, by cofactors.

    `jnp.linalg.inv` calls a decomposition, which XLA can't fuse: ten launches on an
    accelerator, and as many again for the derivative.
    """
    first, second, third = matrix
    columns = jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)
    return jnp.stack(columns, axis=1) / jnp.sum(first * columns[0])


@jax.custom_jvp
def clip01(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clamp to [0, 1]. At a kink the derivative is the one from above: 1 at 0, 0 at 1."""
    return jnp.clip(x, 0, 1)


@clip01.defjvp
def _clip01_jvp(primals, tangents):
    (x,), (x_dot,) = primals, tangents
    return clip01(x), jnp.where((x >= 0) & (x < 1), x_dot, 0)


@one_program
def absolute(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Absolute value. At 0 the derivative is the one from above, 1."""
    return jnp.where(x < 0, -x, x)
