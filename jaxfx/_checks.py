"""The checks of arguments: read as an array or a number, or refused by name.

`as_array` reads every array of the public face, whoever made it; `parameter`, `check_image` and
`check_depth` ask more of it. `whole_number`, `number` and `option` read what is static.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


# Static numbers as people have them, Python's and NumPy's.
WholeNumber = int | np.integer
Number = int | float | np.integer | np.floating
# A share may pass 0 and 1 by so much: a filter that made it rounds.
_ROUNDING = 1e-3
# An array of more numbers is not shown in full.
_SHOWN = 16
_SCALARS = np.generic | np.ndarray | jax.Array


def is_concrete(*values: Any) -> bool:
    """Whether the numbers behind `values` can be looked at now, outside any transform."""
    leaves = jax.tree.leaves(values)
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def as_array(name: str, value: Any) -> Array:
    """`value` as an array of real numbers or booleans, in its own type.

    Bytes in another machine's order are turned round, which changes no number. `ValueError`
    names what is no array, and what would lose numbers on the way.
    """
    array = value if isinstance(value, jax.Array) else _from_outside(name, value)
    kinds = (jnp.bool_, jnp.integer, jnp.floating)
    if not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise _not_real(name, array)
    read = _converted(array)
    if jnp.issubdtype(read.dtype, jnp.integer) and read.dtype.itemsize < array.dtype.itemsize:
        held = np.iinfo(read.dtype)
        if array.size and not held.min <= array.min() <= array.max() <= held.max:
            raise ValueError(
                f"`{name}` must hold numbers that {read.dtype} has, got {array.dtype} from "
                f"{array.min()} to {array.max()}."
            )
    return read


def _converted(array: Any, dtype: Any = None) -> Array:
    """A JAX array of a type; of what can be looked at one that can be, inside a trace too."""
    if not is_concrete(array):
        return jnp.asarray(array, dtype)
    with jax.ensure_compile_time_eval():
        return jnp.asarray(array, dtype)


def as_numpy(name: str, value: Any) -> np.ndarray:
    """What `as_array` reads, on the host and in full: for files."""
    array = np.asarray(value if isinstance(value, jax.Array) else _from_outside(name, value))
    if array.dtype.kind == "c":
        raise _not_real(name, array)
    return array


def _not_real(name: str, array: Any) -> ValueError:
    what = "hold real numbers" if array.ndim else "be a real number"
    return ValueError(f"`{name}` must {what}, got {array.dtype}.")


def _from_outside(name: str, value: Any) -> Any:
    """What is no JAX array yet, as one of NumPy, or of JAX where it is made of such."""
    if isinstance(value, Mapping):
        raise ValueError(
            f"`{name}` must be one array, got a {type(value).__name__} with the keys "
            f"{[*value]!r:.60}. Channels become an image by `np.stack([...], axis=-1)`."
        )
    if value is None or isinstance(value, str | bytes | Set):
        raise ValueError(f"`{name}` must be an array, got {value!r:.40}.")
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(
            f"`{name}` must have a number everywhere, got a masked array. Fill what is masked "
            "by `array.filled(number)`: a missing depth is 0 or NaN."
        )
    kind = type(value).__name__
    try:
        if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
            return jnp.asarray(value)
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"`{name}` must be an array, got a {kind}: {error}") from error
    if array.dtype.kind not in "biufc" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"`{name}` must hold real numbers, got a {kind} of {array.dtype}.")
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    return array.astype(np.float64) if array.dtype == np.longdouble else array


def parameter(
    name: str, value: Any, shape: tuple[int, ...] | None = (), *, booleans: bool = False
) -> Array:
    """`value` as a strongly typed float array of `shape`; `ValueError` names it otherwise.

    Python numbers and integers take JAX's default float type; a float array, traced or not,
    keeps its own. Without a shape any will do. With `booleans` they are 0 and 1.
    """
    if not isinstance(value, jax.Array):
        value = _from_outside(name, value)
        if value.dtype.kind in "iu":  # Before JAX, which may not hold so large an integer.
            value = value.astype(np.float64)
    array = as_array(name, value)
    if array.dtype == jnp.bool_ and not booleans:
        raise _not_real(name, array)
    if not jnp.issubdtype(array.dtype, jnp.floating) or array.weak_type:
        array = _converted(array, jnp.result_type(float))
    if shape is not None:
        check_shape(name, array, shape)
    return array


def check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` where an array has another shape."""
    found = jnp.shape(array)
    if found != shape:
        batch = found[len(found) - len(shape) :] == shape
        hint = " Batches are made with `jax.vmap`." if batch else ""
        raise ValueError(f"`{name}` must have shape {shape}, got {found}.{hint}")


def check_fields(name: str, module: Any) -> None:
    """Raise `ValueError` where a field of a camera, lens or light is that of several."""
    for field, shape in module.SHAPES.items():
        found = jnp.shape(getattr(module, field))
        if found != shape:
            kind = type(module).__name__
            raise ValueError(
                f"`{name}` must be one {kind}, whose `{field}` has shape {shape}, "
                f"got {found}. Batches are made with `jax.vmap`."
            )


def check(name: str, value: Array, valid: Callable[[Any], Any], expected: str) -> None:
    """Raise `ValueError` if `value` is concrete and `valid(value)` is not true everywhere."""
    if not is_concrete(value):
        return
    numbers = np.asarray(value)
    wrong = ~np.broadcast_to(valid(numbers), numbers.shape)
    if wrong.any():
        shown = " ".join(str(numbers).split())
        if numbers.size > _SHOWN:
            first = tuple(np.argwhere(wrong)[0].tolist())
            shown = f"{numbers[first]} at {list(first)}, one of {wrong.sum()} that are wrong"
        raise ValueError(f"`{name}` must be {expected}, got {shown}.")


def share(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """`value` as floats in [0, 1], booleans as 0 and 1; a NaN is left to its own pixel."""
    array = parameter(name, value, shape, booleans=True)
    valid = lambda v: ~((v < -_ROUNDING) | (v > 1 + _ROUNDING))
    check(name, array, valid, "in [0, 1]")
    return array


def shares(name: str, values: Any, count: int, shape: tuple[int, ...]) -> list[Array | None]:
    """A share, or None, for each of some lights; None alone stands for None for each."""
    found = [None] * count if values is None else items(name, values, "a sequence")
    if len(found) != count:
        what = "an image" if len(shape) == 2 else "numbers"
        raise ValueError(
            f"`{name}` must hold {what} or None for each of {count} lights, got {len(found)}."
        )
    return [
        each if each is None else share(f"{name}[{index}]", each, shape)
        for index, each in enumerate(found)
    ]


def check_image(name: str, image: Any) -> Array:
    """`image` as an array, height width channel, of floats; `ValueError` otherwise."""
    array = as_array(name, image)
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


def check_map(name: str, depth: Any) -> Array:
    """`depth` as a float array of two dimensions, neither 0; `ValueError` otherwise."""
    array = parameter(name, depth, None)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"`{name}` must have shape (height, width), neither of them 0, "
            f"got {array.shape}. Batches are made with `jax.vmap`."
        )
    return array


def check_depth(name: str, depth: Any, shape: tuple[int, ...]) -> Array:
    """`depth` as a float array of `shape`, of whatever values; `ValueError` otherwise.

    Positive is a depth, inf is background; 0, negative and NaN are missing.
    """
    array = parameter(name, depth, None)
    if array.shape != shape:
        raise ValueError(
            f"`{name}` must have the image's height and width {shape}, got {array.shape}."
        )
    return array


def items(name: str, values: Any, expected: str = "a sequence of at least one") -> list[Any]:
    """The items of a sequence, or of an array's first axis; `ValueError` otherwise."""
    is_array = isinstance(values, np.ndarray | jax.Array) and values.ndim > 0
    if not (is_array or (isinstance(values, Sequence) and not isinstance(values, str))):
        raise ValueError(f"`{name}` must be {expected}, got {type(values).__name__}.")
    return list(values)


def option(name: str, value: Any, options: Sequence[str]) -> Any:
    """One of some names; `ValueError` otherwise."""
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"`{name}` must be one of {tuple(options)}, got {value!r:.60}.")
    return value


def whole_number(
    name: str,
    value: Any,
    valid: Callable[[int], bool] = lambda n: n >= 1,
    expected: str = "a positive integer",
) -> int:
    """A static integer, of Python's or of NumPy's; `ValueError` names anything else."""
    found = _static(name, value, expected)
    if not isinstance(found, int) or not valid(found):
        raise ValueError(f"`{name}` must be {expected}, got {value!r:.60}.")
    return found


def number(
    name: str,
    value: Any,
    valid: Callable[[float], bool] = lambda x: x > 0,
    expected: str = "positive",
) -> float:
    """A static number, of Python's or of NumPy's; `ValueError` names anything else."""
    found = _static(name, value, expected)
    if not isinstance(found, int | float) or not valid(found):
        raise ValueError(f"`{name}` must be {expected}, got {value!r:.60}.")
    return float(found)


def _static(name: str, value: Any, expected: str) -> Any:
    """What a Python or NumPy scalar holds, as Python's own type; no number for a boolean."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"`{name}` must be {expected} and static, got a traced value: give a Python number."
        )
    if isinstance(value, _SCALARS) and value.ndim == 0:
        value = value.item()
    return None if isinstance(value, bool) else value
