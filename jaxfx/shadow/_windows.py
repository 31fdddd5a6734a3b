"""Running minimum and maximum: one axis after the other."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def extremes(
    image: Float[Array, "height width"], size: int
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """The smallest and the largest pixel of every `size` x `size` window inside the image.

    `size` is odd. No pixel may be a NaN.
    """
    image = jax.lax.stop_gradient(image)
    if size == 1:
        return image, image
    smallest = _running(image, size // 2, jnp.less, jax.lax.min, np.inf)
    return smallest, _running(image, size // 2, jnp.greater, jax.lax.max, -np.inf)


def _running(image, reach, wins, operation, worst):
    worst = np.asarray(worst, image.dtype)
    for axis in (0, 1):
        kept = image.shape[axis] - reach
        shifts = (jax.lax.slice_in_dim(image, k, k + kept, axis=axis) for k in range(reach + 1))
        # `minimum` would spend as much again on NaNs.
        half = ft.reduce(lambda a, b: jnp.where(wins(a, b), a, b), shifts)
        # Both halves as a window of two: XLA fuses this with nothing, where slices of the two
        # axes would be fused into one pass of size**2 reads.
        window, dilation = [1, 1], [1, 1]
        window[axis], dilation[axis] = 2, reach
        image = jax.lax.reduce_window(
            half, worst, operation, window, (1, 1), "VALID", window_dilation=dilation
        )
    return image
