"""The checks of arguments: read as an array or a number, or refused by name."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


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
