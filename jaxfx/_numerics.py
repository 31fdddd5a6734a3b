"""Square roots, norms and quotients with finite gradients, and the checks of arguments.

The floor under everything else: arrays only, no types of this package.
"""

import functools
import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float


def is_concrete(*values: Any) -> bool:
    """Whether the numbers behind `values` can be looked at now, outside any transform."""
    leaves = jax.tree.leaves(values)
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def parameter(name: str, value: Any, shape: tuple[int, ...] = ()) -> Array:
    """`value` as a strongly typed float array of `shape`; `ValueError` names it otherwise.

    Python numbers and integers take JAX's default float type; a float array, traced or not,
    keeps its own.
    """
    array = jnp.asarray(value)
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == jnp.bool_:
        raise ValueError(f"`{name}` must be a real number, got {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating) or array.weak_type:
        array = jnp.asarray(array, dtype=jnp.result_type(float))
    if array.shape != shape:
        raise ValueError(f"`{name}` must have shape {shape}, got {array.shape}.")
    return array


def check(name: str, value: Array, valid: Any, expected: str) -> None:
    """Raise `ValueError` if `value` is concrete and `valid(value)` is not true everywhere."""
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        shown = value if value.ndim == 0 else "an array with other values"
        raise ValueError(f"`{name}` must be {expected}, got {shown}.")


def check_image(name: str, image: Any) -> Array:
    """`image` as an array, height width channel, of floats; `ValueError` otherwise."""
    array = jnp.asarray(image)
    if array.ndim != 3 or 0 in array.shape:
        raise ValueError(
            f"`{name}` must be an image of shape (height, width, channel), none of them 0, "
            f"got shape {array.shape}. Batches are made with `jax.vmap`."
        )
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(
            f"`{name}` must hold floats (linear radiance), got {array.dtype}. Convert an "
            "8-bit picture with `jaxfx.io.read_png`, which also undoes its sRGB curve."
        )
    return array


def check_depth(name: str, depth: Any, shape: tuple[int, ...]) -> Array:
    """`depth` as a positive float array of `shape`; `ValueError` otherwise.

    The values can be looked at only outside `jit`, `grad` and `vmap`.
    """
    array = jnp.asarray(depth)
    if array.shape != shape:
        raise ValueError(
            f"`{name}` must have the image's height and width {shape}, got {array.shape}."
        )
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"`{name}` must hold floats (scene units), got {array.dtype}.")
    if is_concrete(array):
        values = np.asarray(array)
        wrong = ~(values > 0)
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise ValueError(
                f"`{name}` must be positive (background is inf), got {values[row, column]} at "
                f"row {row}, column {column}; {wrong.sum()} pixels of {wrong.size} are wrong."
            )
    return array


def working_dtype(*dtypes: DTypeLike) -> jnp.dtype:
    """The type that images of `dtypes` are computed in: the widest, float32 at least."""
    # Asked for by name, so allowed where promotion is strict.
    with jax.numpy_dtype_promotion("standard"):
        return jnp.result_type(*dtypes, jnp.float32)


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
