"""Depth of field by blending the image with one blurred copy."""

import functools as ft
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number
from jaxfx._filter import folded
from jaxfx._linear import linear
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, clip01
from jaxfx.dof._discs import vogel
from jaxfx.dof.arguments import check_arguments, defocused
from jaxfx.dof.gather import mix
from jaxfx.lens import Lens


# Taps beside the centre, as in the source. More smooth the pattern that large radii show.
_TAPS = 12


@on_any_mesh
def blend(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
) -> Float[Array, "height width channel"]:
    """Depth of field by mixing the image with a blurred copy of it. Kept for comparison.

    The copy is blurred as widely at every pixel as the largest circle of confusion: a pixel
    slightly out of focus shows its sharp self through a wide blur, a sharp foreground leaks
    into its background, and at large radii the taps show.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its circle of confusion C, in pixels.
    - `max_coc`: static; the diameter, in pixels, at which nothing of the sharp image is left.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from the data.

    **Returns:** height width channel, in the type of `image`. A pixel that is not a number
    spoils the pixels out of focus whose taps read it, 0.71 `max_coc` + 2 away at the most. One
    whose depth is missing is left out of the blur, and keeps its own colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, or no `max_coc`
    under a transform.

    **Gradient:** exact with respect to `image`, `depth` and every field of `lens`; zero where a
    circle is clamped.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.blend(image, depth, lens).shape
    (8, 8, 3)

    The result is `lerp(image, blur, clamp(C / max_coc))`. The blur is the mean of the pixel and
    12 taps about it, applied twice.

    Source: simple depth of field, the two blurs and the lerp, in which the share was
    `clamp(range * |focus - Z|)`. Reconstructed: where its 12 taps lie (here a Vogel spiral,
    with 1/sqrt(2) of the radius in each pass, so that both together have the disc's variance).
    """
    image, depth, lens, max_coc = check_arguments("blend", image, depth, lens, max_coc)
    return _blend(image, depth, lens, max_coc)


@ft.partial(jax.jit, static_argnames=("max_coc",))
def _blend(image, depth, lens, max_coc):
    dtype = image.dtype
    view = defocused(image, depth, lens, max_coc)
    image = jnp.where(view.bad[..., None], jnp.nan, view.image)
    kernel = taps_kernel(max_coc / 2 / math.sqrt(2))
    # Pixels whose depth is missing are left out; the last channel is the weight that is left.
    planes = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    planes = jnp.where(view.missing[..., None], 0, planes)
    planes = _filter(_filter(planes, kernel), kernel)
    left = jnp.where(planes[..., -1:] > 0, planes[..., -1:], 1)
    share = clip01(absolute(view.defocus) / max_coc)
    result = mix(image, planes[..., :-1] / left, share[..., None])
    return jnp.where(view.lost[..., None], jnp.nan, result).astype(dtype)


def taps_kernel(radius: float) -> Float[np.ndarray, "side side"]:
    """The weights of a pixel and 12 bilinear taps on a disc about it; their sum is 1."""
    reach = math.ceil(radius)
    kernel = np.zeros((2 * reach + 2, 2 * reach + 2))
    for x, y in radius * vogel(_TAPS + 1) + reach:
        column, row = math.floor(x), math.floor(y)
        right, down = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer(
            [1 - down, down], [1 - right, right]
        )
    return kernel[:-1, :-1] / (_TAPS + 1)


def _filter(
    image: Float[Array, "height width channel"], kernel: Float[np.ndarray, "side side"]
) -> Float[Array, "height width channel"]:
    """`image` filtered by a small sparse kernel; its last pixels go on beyond the frame."""
    reach = len(kernel) // 2

    def push(image: Array) -> Array:
        return _sums(jnp.pad(image, _margin(reach), mode="edge"), kernel)

    def pull(bar: Array) -> Array:
        wide = jnp.pad(bar, _margin(2 * reach))
        return folded(_sums(wide, kernel[::-1, ::-1]), reach)

    return push(image) if 1 in image.shape[:2] else linear(push, pull, push, image)


def _margin(pixels: int) -> tuple[tuple[int, int], ...]:
    return (pixels, pixels), (pixels, pixels), (0, 0)


def _sums(
    wide: Float[Array, "H W channel"], kernel: Float[np.ndarray, "side side"]
) -> Float[Array, "height width channel"]:
    """The sums under the kernel at every place where it fits into `wide`."""
    height, width = (size - len(kernel) + 1 for size in wide.shape[:2])
    channels = wide.shape[2]
    rows = wide.reshape(len(wide), -1)  # pixels and channels as one long axis
    total = jnp.zeros((height, width * channels), wide.dtype)
    for row, column in np.argwhere(kernel):
        start = column * channels
        part = rows[row : row + height, start : start + width * channels]
        total = total + jnp.asarray(kernel[row, column], wide.dtype) * part
    return total.reshape(height, width, channels)
