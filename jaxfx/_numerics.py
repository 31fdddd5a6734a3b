"""Square roots, norms and quotients with finite gradients; the inverse of a small matrix.

The floor under everything else: arrays only, no types of this package.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float


def common_dtype(*dtypes: DTypeLike) -> jnp.dtype:
    """The widest of `dtypes`, asked for by name, so allowed where promotion is strict."""
    with jax.numpy_dtype_promotion("standard"):
        return jnp.result_type(*dtypes)


def working_dtype(*dtypes: DTypeLike) -> jnp.dtype:
    """The type that images of `dtypes` are computed in: the widest, float32 at least."""
    return common_dtype(*dtypes, jnp.float32)


@jax.custom_jvp
def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose value and derivative are 0 where `x` is 0 or negative.

    Not by a double `where`: XLA may compute its predicate twice, rounded differently, and then
    selects what stood in for the root.
    """
    return jnp.sqrt(jnp.maximum(x, 0))


@safe_sqrt.defjvp
def _safe_sqrt_jvp(primals, tangents):
    (x,), (x_dot,) = primals, tangents
    root = safe_sqrt(x)
    floor = math.sqrt(jnp.finfo(x.dtype).tiny)  # its square, in a second derivative, is not 0
    return root, root / (2 * jnp.maximum(x, floor)) * x_dot


def safe_divide(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x / y`, with value and derivatives 0 where `y` is 0."""
    nonzero = y != 0
    return jnp.where(nonzero, x / jnp.where(nonzero, y, 1), 0)


def sum_planes(planes: Float[Array, "..."], axis: int = 0) -> Float[Array, "..."]:
    """The sum over a short axis before the last, plane by plane.

    XLA's own reduction over such an axis takes ten times as long on a CPU.
    """
    return functools.reduce(jnp.add, jnp.moveaxis(planes, axis, 0))


def normalize(vector: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """Unit vectors along the last axis; the zero vector stays zero, with zero derivative."""
    length = safe_sqrt(jnp.sum(vector * vector, axis=-1, keepdims=True))
    return safe_divide(vector, length)


def inverse(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The inverse, by cofactors.

    A decomposition is a chain of calls that nothing can be fused with: ten launches, and as
    many again for its derivative.
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


def absolute(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Absolute value. At 0 the derivative is the one from above, 1."""
    return jnp.where(x < 0, -x, x)
