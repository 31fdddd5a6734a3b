"""Which pixels `edge_pcf` filters: those near shadow edges, by depth or in the image."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfx.shadow.compare import Texels, half_width, mean_comparison, set_up


def find_edges(
    size, edges, dilation, shadow_map, receivers, bias, slope_bias, softness
) -> tuple[Texels, Bool[Array, "height width"], Float[Array, "height width"]]:
    """The padded map, the mask of pixels to filter, and the visibility outside of the mask."""
    texels, places = set_up(shadow_map, receivers, bias, slope_bias, size)
    if edges == "screen":
        hard = mean_comparison(texels, places, None, 1, "box")
        return texels, _near_image_edges(hard, dilation), hard
    windows, reach = extremes(texels, size), size // 2
    index = (places.row - reach) * windows[0].shape[1] + (places.column - reach)
    nearest, farthest = (
        window.reshape(-1).at[index].get(mode="promise_in_bounds") for window in windows
    )
    if softness is None:
        all_lit, any_lit = nearest >= places.threshold, farthest >= places.threshold
    else:
        half = half_width(softness, texels.dtype)
        all_lit = nearest - places.threshold >= half
        any_lit = farthest - places.threshold > -half
    visibility = (all_lit.astype(texels.dtype) + any_lit.astype(texels.dtype)) / 2
    return texels, visibility == 0.5, visibility


def _near_image_edges(
    hard: Float[Array, "height width"], dilation: int
) -> Bool[Array, "height width"]:
    """Where lit and shadowed pixels lie within `dilation` pixels along both axes."""
    lit, shadowed = jnp.uint8(1), jnp.uint8(2)
    padded = jnp.pad(jnp.where(hard > 0, lit, shadowed), dilation)
    return unions(padded, 2 * dilation + 1) == lit | shadowed


def extremes(
    image: Float[Array, "height width"], size: int
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """The smallest and the largest pixel of every `size` x `size` window inside the image.

    `size` is odd. No pixel may be NaN: `jnp.minimum` handles NaNs, and costs twice as much.
    """
    image, worst = jax.lax.stop_gradient(image), np.asarray(np.inf, image.dtype)
    smaller, larger = (
        lambda a, b: jnp.where(a < b, a, b),
        lambda a, b: jnp.where(a > b, a, b),
    )
    smallest = _over_windows(image, size, smaller, jax.lax.min, worst)
    return smallest, _over_windows(image, size, larger, jax.lax.max, -worst)


def unions(image: UInt8[Array, "height width"], size: int) -> UInt8[Array, "rows columns"]:
    """The bits that are set somewhere in every `size` x `size` window inside the image."""
    return _over_windows(image, size, jnp.bitwise_or, jax.lax.bitwise_or, np.uint8(0))


def _over_windows(image, size, pick, operation, start):
    """An idempotent operation over all windows, one axis after the other.

    `pick` and `operation` are the same operation, of two arrays and of a `reduce_window`.
    """
    reach = size // 2
    if reach == 0:
        return image
    for axis in (0, 1):
        kept = image.shape[axis] - reach
        shifts = (jax.lax.slice_in_dim(image, k, k + kept, axis=axis) for k in range(reach + 1))
        half = ft.reduce(pick, shifts)
        # A window is two overlapping halves, combined by a `reduce_window` of two elements: XLA
        # fuses that with nothing. It would fuse slices along both axes into size**2 reads.
        window, dilation = [1, 1], [1, 1]
        window[axis], dilation[axis] = 2, reach
        image = jax.lax.reduce_window(
            half, start, operation, window, (1, 1), "VALID", window_dilation=dilation
        )
    return image
