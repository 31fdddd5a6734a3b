"""Running minimum, maximum and union: one axis after the other."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8


def extremes(
    image: Float[Array, "height width"], size: int
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """The smallest and the largest pixel of every `size` x `size` window inside the image.

    `size` is odd. No pixel may be a NaN.
    """
    # `minimum` would spend as much again on NaNs.
    image, worst = jax.lax.stop_gradient(image), np.asarray(np.inf, image.dtype)
    smaller, larger = (
        lambda a, b: jnp.where(a < b, a, b),
        lambda a, b: jnp.where(a > b, a, b),
    )
    smallest = _running(image, size, smaller, jax.lax.min, worst)
    return smallest, _running(image, size, larger, jax.lax.max, -worst)


def unions(image: UInt8[Array, "height width"], size: int) -> UInt8[Array, "rows columns"]:
    """The bits that are set somewhere in every `size` x `size` window inside the image."""
    return _running(image, size, jnp.bitwise_or, jax.lax.bitwise_or, np.uint8(0))


def _running(image, size, pick, operation, start):
    reach = size // 2
    if reach == 0:
        return image
    for axis in (0, 1):
        kept = image.shape[axis] - reach
        shifts = (jax.lax.slice_in_dim(image, k, k + kept, axis=axis) for k in range(reach + 1))
        half = ft.reduce(pick, shifts)
        # Both halves as a window of two: XLA fuses this with nothing, where slices of the two
        # axes would be fused into one pass of size**2 reads.
        window, dilation = [1, 1], [1, 1]
        window[axis], dilation[axis] = 2, reach
        image = jax.lax.reduce_window(
            half, start, operation, window, (1, 1), "VALID", window_dilation=dilation
        )
    return image
