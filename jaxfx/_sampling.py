"""Where pixels are. The pixel-centre rule of the package lives here alone.

Pixel (row j, column i) covers [i, i + 1) x [j, j + 1); its centre is (i + 0.5, j + 0.5), and
coordinates are always (x, y).
"""

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float


def pixel_centers(
    height: int, width: int, dtype: DTypeLike | None = None
) -> Float[Array, "height width 2"]:
    """The coordinates (x, y) of every pixel's centre."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    x = jnp.arange(width, dtype=dtype) + 0.5
    y = jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
