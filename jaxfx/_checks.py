"""Checks of arguments: each becomes an array or a number, or a `ValueError` names it.

Every public function converts its arrays by `as_array`, or by `parameter`, `check_image` or
`check_depth`, which check more. `whole_number`, `number` and `option` read static arguments.
The first parameter, `name`, is the argument's name in errors: "scatter(max_coc=...)".
"""

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


# Static numbers, of Python or NumPy.
WholeNumber = int | np.integer
Number = int | float | np.integer | np.floating
# How far a visibility may lie outside [0, 1]: filters that compute one round. With 0 such a
# result would be refused; a large tolerance would hide values of another unit.
_ROUNDING = 1e-3
# Errors show an array of at most this many numbers in full, of a larger one a wrong entry.
_MAX_SHOWN = 16
_SCALARS = np.generic | np.ndarray | jax.Array


def is_concrete(*values: Any) -> bool:
    """Whether all arrays in `values` have values now: none of them is traced."""
    leaves = jax.tree.leaves(values)
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def with_numbers(module: Any) -> str:
    """The text of a module of scalars with their values, where these are known.

    Equinox' own shows types and shapes, `f32[]`, of which a scalar's value is not one.
    """

    def text(value: Any) -> str:
        is_number = isinstance(value, jax.Array | np.ndarray | float | int)
        if is_number and is_concrete(value) and np.ndim(value) == 0:
            return f"{np.asarray(value)[()]:.6g}"
        return eqx.tree_pformat(value)

    fields = (f"{name}={text(value)}" for name, value in vars(module).items())
    return f"{type(module).__name__}({', '.join(fields)})"


def as_array(name: str, value: Any) -> Array:
    """`value` as an array of real numbers or booleans, in its own type.

    Its byte order becomes this machine's. `ValueError` where it is no array, or holds integers
    that JAX's integer type can't.
    """
    array = value if isinstance(value, jax.Array) else _to_numpy(name, value)
    kinds = (jnp.bool_, jnp.integer, jnp.floating)
    if not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        raise _not_real(name, array)
    result = _to_jax(array)
    dtype = result.dtype
    if jnp.issubdtype(dtype, jnp.integer) and dtype.itemsize < array.dtype.itemsize:
        limits = np.iinfo(dtype)
        if array.size and not limits.min <= array.min() <= array.max() <= limits.max:
            raise ValueError(
                f"`{name}` must hold numbers that {dtype} has, got {array.dtype} from "
                f"{array.min()} to {array.max()}."
            )
    return result


def _to_jax(array: Any, dtype: Any = None) -> Array:
    """`array` as a JAX array; a concrete one stays concrete, inside a trace too."""
    if not is_concrete(array):
        return jnp.asarray(array, dtype)
    with jax.ensure_compile_time_eval():
        if isinstance(array, jax.Array):
            return jnp.asarray(array, dtype)
        # As `jnp.asarray` does, but without a program for every shape. On a CPU the device may
        # share the memory of a NumPy array, which its owner may write to: hence a copy.
        return jax.device_put(np.array(array, dtype))


def as_numpy(name: str, value: Any) -> np.ndarray:
    """`value` as a NumPy array of its own type, checked as by `as_array`: for files."""
    array = np.asarray(value if isinstance(value, jax.Array) else _to_numpy(name, value))
    if array.dtype.kind == "c":
        raise _not_real(name, array)
    return array


def _not_real(name: str, array: Any) -> ValueError:
    """The error for an array, or a scalar, whose type is not real."""
    expected = "hold real numbers" if array.ndim else "be a real number"
    return ValueError(f"`{name}` must {expected}, got {array.dtype}.")


def _to_numpy(name: str, value: Any) -> Any:
    """A value that is no JAX array, as a NumPy array; a list of JAX arrays as a JAX array."""
    if isinstance(value, Mapping):
        raise ValueError(
            f"`{name}` must be one array, got a {type(value).__name__} with the keys "
            f"{[*value]!r:.60}. Channels become an image by `np.stack([...], axis=-1)`."
        )
    if value is None or isinstance(value, str | bytes | Set):
        raise ValueError(f"`{name}` must be an array, got {value!r:.40}.")
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(
            f"`{name}` must have a number everywhere, got a masked array. Fill masked entries "
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
    """`value` as a strongly typed float array of `shape`; `ValueError` otherwise.

    Python's numbers and integers become JAX's default float type; a float array, traced or not,
    keeps its type. `shape=None` accepts any shape; with `booleans`, booleans become 0 and 1.
    """
    if not isinstance(value, jax.Array):
        value = _to_numpy(name, value)
        if value.dtype.kind in "iu":  # Before JAX, whose integers may be smaller.
            value = value.astype(np.float64)
    array = as_array(name, value)
    if array.dtype == jnp.bool_ and not booleans:
        raise _not_real(name, array)
    if not jnp.issubdtype(array.dtype, jnp.floating) or array.weak_type:
        array = _to_jax(array, jnp.result_type(float))
    if shape is not None:
        check_shape(name, array, shape)
    return array


def check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` where an array has another shape."""
    actual = jnp.shape(array)
    if actual != shape:
        is_batch = actual[len(actual) - len(shape) :] == shape
        hint = " Batches are made with `jax.vmap`." if is_batch else ""
        raise ValueError(f"`{name}` must have shape {shape}, got {actual}.{hint}")


def check_fields(name: str, module: Any) -> None:
    """Raise `ValueError` where a camera, lens or light is a batch: by its fields' shapes."""
    for field, shape in module.SHAPES.items():
        actual = jnp.shape(getattr(module, field))
        if actual != shape:
            kind = type(module).__name__
            raise ValueError(
                f"`{name}` must be one {kind}, whose `{field}` has shape {shape}, "
                f"got {actual}. Batches are made with `jax.vmap`."
            )


def check(name: str, value: Array, valid: Callable[[Any], Any], expected: str) -> None:
    """Raise `ValueError` if `value` is concrete and `valid(value)` is not true everywhere."""
    if not is_concrete(value):
        return
    numbers = np.asarray(value)
    is_wrong = ~np.broadcast_to(valid(numbers), numbers.shape)
    if is_wrong.any():
        shown = " ".join(str(numbers).split())
        if numbers.size > _MAX_SHOWN:
            first = tuple(np.argwhere(is_wrong)[0].tolist())
            shown = f"{numbers[first]} at {list(first)}, one of {is_wrong.sum()} that are wrong"
        raise ValueError(f"`{name}` must be {expected}, got {shown}.")


def share(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """`value` as floats in [0, 1]: a visibility, say. Booleans become 0 and 1, NaN passes."""
    array = parameter(name, value, shape, booleans=True)
    valid = lambda v: ~((v < -_ROUNDING) | (v > 1 + _ROUNDING))
    check(name, array, valid, "in [0, 1]")
    return array


def shares(name: str, values: Any, count: int, shape: tuple[int, ...]) -> list[Array | None]:
    """One visibility, as by `share`, or None per light; None alone stands for all None."""
    sequence = [None] * count if values is None else items(name, values, "a sequence")
    if len(sequence) != count:
        expected = "an image" if len(shape) == 2 else "numbers"
        raise ValueError(
            f"`{name}` must hold {expected} or None for each of {count} lights, "
            f"got {len(sequence)}."
        )
    return [
        None if value is None else share(f"{name}[{index}]", value, shape)
        for index, value in enumerate(sequence)
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
            "8-bit image with `jaxfx.io.read_png`, which also undoes its sRGB curve."
        )
    return array


def check_map(name: str, depth: Any) -> Array:
    """`depth` as a float array, height width, neither of them 0; `ValueError` otherwise."""
    array = parameter(name, depth, None)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"`{name}` must have shape (height, width), neither of them 0, "
            f"got {array.shape}. Batches are made with `jax.vmap`."
        )
    return array


def check_depth(name: str, depth: Any, shape: tuple[int, ...]) -> Array:
    """`depth` as a float array of `shape`; `ValueError` otherwise.

    Any value is accepted: inf is background; 0, negative and NaN are missing.
    """
    array = parameter(name, depth, None)
    if array.shape != shape:
        raise ValueError(
            f"`{name}` must have the image's height and width {shape}, got {array.shape}."
        )
    return array


def items(name: str, values: Any, expected: str = "a sequence of at least one") -> list[Any]:
    """The items of a sequence, or of an array along its first axis; `ValueError` otherwise."""
    is_array = isinstance(values, np.ndarray | jax.Array) and values.ndim > 0
    if not (is_array or (isinstance(values, Sequence) and not isinstance(values, str))):
        raise ValueError(f"`{name}` must be {expected}, got {type(values).__name__}.")
    return list(values)


def option(name: str, value: Any, options: Sequence[str]) -> Any:
    """`value`, which must be one of the names `options`; `ValueError` otherwise."""
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"`{name}` must be one of {tuple(options)}, got {value!r:.60}.")
    return value


def whole_number(
    name: str,
    value: Any,
    valid: Callable[[int], bool] = lambda n: n >= 1,
    expected: str = "a positive integer",
) -> int:
    """A static integer of Python or NumPy that is `valid`; `ValueError` otherwise."""
    scalar = _static(name, value, expected)
    if not isinstance(scalar, int) or not valid(scalar):
        raise ValueError(f"`{name}` must be {expected}, got {value!r:.60}.")
    return scalar


def number(
    name: str,
    value: Any,
    valid: Callable[[float], bool] = lambda x: x > 0,
    expected: str = "positive",
) -> float:
    """A static number of Python or NumPy that is `valid`; `ValueError` otherwise."""
    scalar = _static(name, value, expected)
    if not isinstance(scalar, int | float) or not valid(scalar):
        raise ValueError(f"`{name}` must be {expected}, got {value!r:.60}.")
    return float(scalar)


def _static(name: str, value: Any, expected: str) -> Any:
    """A scalar as a Python object, None for a boolean; `ValueError` where it is traced."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"`{name}` must be {expected} and static, got a traced value: give a Python number."
        )
    if isinstance(value, _SCALARS) and value.ndim == 0:
        value = value.item()
    return None if isinstance(value, bool) else value
