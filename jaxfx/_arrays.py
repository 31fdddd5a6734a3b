"""`ArrayLike`, for annotations such as `Float[ArrayLike, "height width"]`.

`jax.typing.ArrayLike` is a union of seven types. jaxtyping applies a shape to each of them, so
that `help()` prints ten lines for one argument. Here it is one class: `help()` prints
`Float[ArrayLike, 'height width']`, and jaxtyping checks the shape as before. It stands for
JAX's and NumPy's arrays and NumPy's scalars. Python's numbers are no arrays: an argument that
may be one says `| float`.
"""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np


if TYPE_CHECKING:
    from jax.typing import ArrayLike
else:

    class _ArrayTypes(type):
        """The type of `ArrayLike`: its instances are those of the array types."""

        def __instancecheck__(cls, value: Any) -> bool:
            return isinstance(value, jax.Array | np.ndarray | np.generic)

    class ArrayLike(metaclass=_ArrayTypes):
        """An array of JAX or NumPy."""


__all__ = ["ArrayLike"]
