"""Images, depths and cameras, smaller by a whole factor, for the first steps of a fit."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfx.camera import PinholeCamera


@functools.partial(jax.jit, static_argnames="factor")
def reduced(image: Array, factor: int) -> Array:
    """The mean over each square of `factor` x `factor` pixels of an image.

    Pixels that fill no square, at the right and at the bottom, are dropped.
    """
    rows, columns = (size // factor for size in image.shape[:2])
    image = image[: rows * factor, : columns * factor]
    return image.reshape(rows, factor, columns, factor, -1).mean(axis=(1, 3))


def thinned(depth: Array, factor: int) -> Array:
    """The depth in the middle of each square of pixels: a mean would mix two surfaces."""
    rows, columns = (size // factor for size in depth.shape)
    middle = depth[factor // 2 :: factor, factor // 2 :: factor]
    return middle[:rows, :columns]


def shrunk(camera: PinholeCamera, factor: int) -> PinholeCamera:
    """The camera of a reduced image."""
    scale = jnp.asarray([[1 / factor], [1 / factor], [1]], camera.intrinsics.dtype)
    return PinholeCamera(camera.intrinsics * scale, camera.world_from_camera)
