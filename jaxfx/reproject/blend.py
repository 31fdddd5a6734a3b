"""Views out of several cameras: blend them, or choose those that are worth it."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_map, whole_number
from jaxfx._choice import Choice
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import safe_divide
from jaxfx._platform import by_platform, kept
from jaxfx._sampling import pixel_centers
from jaxfx._xla import sum_planes
from jaxfx.camera import Camera, PinholeCamera
from jaxfx.reproject.arguments import (
    Search,
    check_depths,
    check_images,
    check_lengths,
    check_search,
    check_size,
    check_threshold,
)
from jaxfx.reproject.view import trace_with_angle


# Pixels. `choose` traces one ray for each square of this side. A larger one is cheaper, and may
# overlook what a camera shows in places smaller than it; `worth` is then a coarser mean.
_STRIDE = 8
# Rays that an accelerator traces at once, of all cameras together. Each takes some 75 bytes;
# with fewer rays at a time there are more launches.
_RAYS_AT_ONCE = 3 * 2**18
# Pixels of one part are a multiple of this: of other numbers XLA fuses less. Measured.
_WHOLE_PIXELS = 2**13


@on_any_mesh
def blend(
    images: Sequence[Float[ArrayLike, "height width channel"]],
    depths: Sequence[Num[ArrayLike, "height width"]],
    cameras: Sequence[PinholeCamera],
    target: Camera,
    *,
    height: WholeNumber | None = None,
    width: WholeNumber | None = None,
    search: Search = "pyramid",
    hole_threshold: Number = 0.1,
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """One image from another camera out of several images, which fill each other's holes.

    Each image is warped as by `warp`; per pixel the nearest surface is shown.

    **Arguments:**

    - `images`: images, each height width channel, linear radiance.
    - `depths`: the depth of each, height width, scene units, as in `warp`.
    - `cameras`: the camera of each.
    - `target`: the camera to see them from.
    - `height`, `width`: static; of the result, in pixels, both or none: the first image's by
      default.
    - `search`, `hole_threshold`: as in `warp`; the latter a ratio of depths.

    **Returns:** `image`, rows columns channel, and `alpha`, rows columns, as `warp` does.

    **Raises:** `ValueError` as `warp`, and for no cameras or lists of different lengths.

    **Gradient:** as that of `warp`; the weights and the choice of the nearer surface are held.

    **Example:** two images with one camera are averaged.

    >>> import numpy as np
    >>> from jaxfx import PinholeCamera, reproject
    >>> dark, bright = np.zeros((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32)
    >>> depth = np.full((8, 8), 2.0, np.float32)
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> image, alpha = reproject.blend([dark, bright], [depth] * 2, [camera] * 2, camera)
    >>> image.shape, float(image[4, 4, 0])
    ((8, 8, 3), 0.5)

    Images whose surface lies within `hole_threshold` of the nearest are averaged. The weight of
    each is the cosine of the angle at which its ray meets the target's there, to the eighth
    power: a camera that looks the same way has the largest.

    Source: the several references that Kim, Ki, Lee & Oh name as future work; the weights are
    our own.
    """
    images, depths, cameras, target = check_images("blend", images, depths, cameras, target)
    size = check_size("blend", height, width, images[0].shape[:2])
    check_search("blend", search)
    hole_threshold = check_threshold("blend", hole_threshold)
    pixels = pixel_centers(*size).reshape(-1, 2)
    options = {"search": search, "hole_threshold": hole_threshold}
    return _blended(images, depths, cameras, target, pixels, size, options)


@eqx.filter_jit
def _blended(
    images: list,
    depths: list,
    cameras: list,
    target: Camera,
    pixels: Array,
    size: tuple[int, int],
    options: dict[str, Any],
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """`blend` of checked arguments, by rays through `pixels` of the target, ray 2.

    `size` is height and width of the result in pixels, `options` are those of `trace_pixels`.
    """
    dtype = images[0].dtype

    def warped(pixels: Array, image: Array, depth: Array, camera: PinholeCamera) -> tuple:
        view, cosine, target_depth = trace_with_angle(depth, camera, target, pixels, **options)
        colors = view.patch.read_colors(image).astype(dtype)
        return colors, view.mask, cosine, target_depth

    def shares_of(mask: Array, cosine: Array, target_depth: Array) -> tuple[Array, Array]:
        """The share of each camera in each pixel, camera pixel, and their sum, 1 or 0."""
        nearest = jnp.min(jnp.where(mask, target_depth, jnp.inf), axis=0)
        is_in_front = mask & (target_depth <= (1 + options["hole_threshold"]) * nearest[None])
        weight = jax.lax.stop_gradient(jnp.where(is_in_front, cosine**8, 0)).astype(dtype)
        weight_sum = sum_planes(weight)
        shares = safe_divide(weight, jnp.broadcast_to(weight_sum, weight.shape))
        return shares, (weight_sum > 0).astype(dtype)

    def blended(pixels: Array) -> tuple[Array, Array]:
        of_source = functools.partial(warped, pixels)
        colors, *found = _over_cameras(of_source, images, depths, cameras)
        shares, alpha = shares_of(*found)
        shares = shares[..., None]
        return sum_planes(jnp.where(shares > 0, colors, 0) * shares), alpha

    def traced(pixels: Array, depth: Array, camera: PinholeCamera) -> tuple:
        view, cosine, target_depth = trace_with_angle(depth, camera, target, pixels, **options)
        return view.patch.normalized(dtype), view.mask, cosine, target_depth

    def of_all_rays(pixels: Array) -> tuple[Array, Array]:
        of_source = functools.partial(traced, pixels)
        patches, *found = _over_cameras(of_source, depths, cameras)
        shares, alpha = shares_of(*found)
        patches = patches._replace(weights=patches.weights * shares[:, None])
        total = jnp.zeros((len(pixels), images[0].shape[2]), dtype)
        for k, image in enumerate(images):
            # All sources then have the same kernel: it is not known whose patches it reads.
            source = jax.lax.optimization_barrier(jnp.int32(k))
            patch = jax.tree.map(lambda x, source=source: x[source], patches)
            total = kept(total + patch.sum_colors(image).astype(dtype))
        return total, alpha

    def in_parts(pixels: Array) -> tuple[Array, Array]:
        parts = -(-len(images) * len(pixels) // _RAYS_AT_ONCE)
        if parts <= 1:
            return of_all_rays(pixels)
        each = -(-len(pixels) // (parts * _WHOLE_PIXELS)) * _WHOLE_PIXELS
        parts = -(-len(pixels) // each)
        filled = jnp.pad(pixels, ((0, parts * each - len(pixels)), (0, 0)), mode="edge")
        found = jax.lax.map(of_all_rays, filled.reshape(parts, each, 2))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: len(pixels)], found)

    image, alpha = by_platform(pixels, cpu=blended, accelerator=in_parts)
    return image.reshape(*size, -1), alpha.reshape(size)


@on_any_mesh
def choose(
    depths: Sequence[Num[ArrayLike, "height width"]],
    cameras: Sequence[PinholeCamera],
    target: Camera,
    *,
    count: WholeNumber,
    height: WholeNumber | None = None,
    width: WholeNumber | None = None,
    hole_threshold: Number = 0.1,
) -> Choice:
    """The few cameras that together show most of a target's view, the most useful first.

    Use it to render or load only the images that `blend` needs.

    **Arguments:**

    - `depths`: the depth of each camera, height width, scene units, as in `warp`.
    - `cameras`: the cameras to choose from.
    - `target`: the camera to see them from.
    - `count`: static; how many to choose.
    - `height`, `width`: static; of the target's image, in pixels, both or none: the first
      depth's by default.
    - `hole_threshold`: static; as in `warp`, a ratio of depths.

    **Returns:** a `Choice`: `chosen` and `worth`, each of shape count, the most useful first.

    **Raises:** `ValueError` as `blend`, and for a `count` not between 1 and their number.

    **Gradient:** of `worth`, with respect to depths and cameras, through what each pixel shows;
    missing: visibility and the choice itself.

    **Example:** the camera at the target's place shows all of it.

    >>> import numpy as np
    >>> from jaxfx import PinholeCamera, reproject
    >>> aside = np.eye(4)
    >>> aside[0, 3] = 1.0
    >>> target = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> other = PinholeCamera.from_fov(1.0, height=8, width=8, world_from_camera=aside)
    >>> depth = np.full((8, 8), 2.0, np.float32)
    >>> choice = reproject.choose([depth, depth], [other, target], target, count=1)
    >>> choice.chosen.tolist(), round(float(choice.worth[0]), 3)
    ([1], 1.0)

    The worth of a camera at a pixel is the cosine between its ray and the target's to the
    surface that the pixel shows, 0 where it shows none; that of several cameras is the largest
    of theirs, averaged over one ray for each 8 x 8 pixels. Greedily, the camera that adds most
    is chosen next. That is at least 63 % of the worth of the best choice of `count` cameras.

    Source: Nemhauser, Wolsey & Fisher 1978, the bound of the greedy choice; the worth is our
    own.
    """
    check_lengths("choose", depths=depths, cameras=cameras)
    most = len(cameras)
    is_valid = lambda n: 1 <= n <= most
    count = whole_number("choose(count=...)", count, is_valid, f"an integer from 1 to {most}")
    depths = [check_map("choose(depths)", depth) for depth in depths]
    size = check_size("choose", height, width, depths[0].shape)
    hole_threshold = check_threshold("choose", hole_threshold)
    rows, columns = (slice(min(_STRIDE, n) // 2, None, _STRIDE) for n in size)
    pixels = pixel_centers(*size)[rows, columns].reshape(-1, 2)
    shapes = [depth.shape for depth in depths]
    depths = check_depths("choose", depths, shapes, cameras, target)
    return _chosen(depths, list(cameras), target, pixels, count, hole_threshold)


@eqx.filter_jit
def _chosen(
    depths: list,
    cameras: list,
    target: Camera,
    pixels: Array,
    count: int,
    hole_threshold: int | float,
) -> Choice:
    """`choose` of checked arguments, by rays through `pixels` of the target, ray 2."""
    options = {"search": "pyramid", "hole_threshold": hole_threshold}

    def worth(depth: Array, camera: PinholeCamera) -> Array:
        view, cosine, _ = trace_with_angle(depth, camera, target, pixels, **options)
        return jnp.where(view.mask, cosine, 0)

    worths = _over_cameras(worth, depths, cameras)
    best, chosen, reached = jnp.zeros_like(worths[0]), [], []
    is_free = jnp.ones(len(worths), bool)
    for _ in range(count):
        best_with = jnp.maximum(worths, best[None])
        index = jnp.argmax(jnp.where(is_free, jnp.sum(best_with, axis=1), -jnp.inf))
        best, is_free = best_with[index], is_free.at[index].set(False)
        chosen.append(index.astype(jnp.int32))
        reached.append(jnp.mean(best))
    return Choice(jnp.stack(chosen), jnp.stack(reached))


def _over_cameras(function: Callable, *lists: Sequence) -> Any:
    """The results for each camera, stacked.

    If all items of each list have the same shapes and types, they share one compiled program.
    """
    kinds = {str(jax.tree.map(jax.typeof, items)) for items in zip(*lists, strict=True)}
    stack = lambda *leaves: jnp.stack(leaves)
    if len(kinds) == 1:
        stacked = tuple(jax.tree.map(stack, *items) for items in lists)
        in_turn = lambda *batch: jax.lax.map(lambda items: function(*items), batch)
        return by_platform(*stacked, cpu=in_turn, accelerator=jax.vmap(function))
    results = [function(*items) for items in zip(*lists, strict=True)]
    return jax.tree.map(stack, *results)
