"""One image from several cameras, and which of many cameras to take."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_image, check_map, items, whole_number
from jaxfx._choice import Choice
from jaxfx._numerics import normalize, safe_divide, sum_planes, working_dtype
from jaxfx._platform import by_platform
from jaxfx._sampling import pixel_centers
from jaxfx.camera import PinholeCamera
from jaxfx.camera._rigid import per_depth
from jaxfx.reproject._rays import Camera
from jaxfx.reproject._view import View, look
from jaxfx.reproject.intersect import Search
from jaxfx.reproject.warp import check_cameras, check_options, check_source


# `choose` looks with one ray for so many pixels of a side.
_STRIDE = 8


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
    """A picture from another camera out of several: each `warp`ed, the nearer surface first.

    Where several sources know a pixel, those whose surface lies within `hole_threshold` of the
    nearest are averaged, each by the cosine of the angle at which its ray meets the target's
    there, to its eighth power: who looks the same way counts most.

    **Arguments:**

    - `images`: pictures, each height width channel, linear radiance.
    - `depths`: the depth of each, height width, scene units, as in `warp`.
    - `cameras`: the camera of each.
    - `target`: the camera to see them from.
    - `height`, `width`: static; size of the result in pixels, both or neither; the first
      image's by default.
    - `search`, `hole_threshold`: as in `warp`; the latter a ratio of depths.

    **Returns:** `image`, rows columns channel, and `alpha`, rows columns, as `warp` does.

    **Raises:** `ValueError` as `warp`, and for no sources or lists of different lengths.

    **Gradient:** as that of `warp`; the weights and the choice of the nearer surface are held.

    Source: the several references that Kim, Ki, Lee & Oh name as future work; the weights are
    our own.
    """
    given = check_sources("blend", images, depths, cameras, target)
    images, depths, cameras, target = given
    size = check_options("blend", (height, width), images[0].shape[:2], search, hole_threshold)
    options = {"search": search, "hole_threshold": float(hole_threshold)}
    seen = Sight(target, pixel_centers(*size).reshape(-1, 2), options)
    return _blended(seen, images, depths, cameras, size)


@eqx.filter_jit
def _blended(
    seen: "Sight", images: list, depths: list, cameras: list, size: tuple[int, int]
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    hole_threshold = seen.options["hole_threshold"]

    def layer(image: Array, depth: Array, camera: PinholeCamera) -> tuple[Array, ...]:
        view, along, z = seen(depth, camera)
        return view.patch.read_colors(image).astype(images[0].dtype), view.mask, along, z

    pictures, masks, along, z = _over_sources(layer, images, depths, cameras)
    nearest = jnp.min(jnp.where(masks, z, jnp.inf), axis=0)
    front = masks & (z <= (1 + hole_threshold) * nearest[None])
    weight = jax.lax.stop_gradient(jnp.where(front, along**8, 0))[..., None]
    weight = weight.astype(pictures.dtype)
    total = sum_planes(jnp.where(weight > 0, pictures, 0) * weight)
    weights = jnp.broadcast_to(sum_planes(weight), total.shape)
    alpha = (weights[:, 0] > 0).astype(total.dtype)
    return safe_divide(total, weights).reshape(*size, -1), alpha.reshape(size)


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
    """The few sources that together show most of a target.

    The worth of a source at a pixel is the cosine between its ray and the target's to what the
    pixel shows, 0 where it shows nothing; that of several is the best of theirs, summed over
    pixels. One after another is added that adds most, which is at least 63 % of the best choice
    of so many. Looked at with one ray for each 8 x 8 pixels.

    **Arguments:**

    - `depths`: the depth of each camera, height width, scene units, as in `warp`.
    - `cameras`: the camera of each.
    - `target`: the camera to see them from.
    - `count`: static; how many to choose.
    - `height`, `width`: static; size of the target in pixels, both or neither; the first
      depth's by default.
    - `hole_threshold`: static; as in `warp`, a ratio of depths.

    **Returns:** a `Choice`: `chosen` and `worth`, each of shape count, the most useful first.

    **Raises:** `ValueError` as `blend`, and for a `count` not between 1 and their number.

    **Gradient:** of `worth`, with respect to depths and cameras, through what each pixel shows;
    missing: visibility and the choice itself.

    Source: Nemhauser, Wolsey & Fisher 1978, the greedy choice's bound; the worth is our own.
    """
    _check_lists("choose", depths=depths, cameras=cameras)
    most = len(cameras)
    is_valid = lambda n: 1 <= n <= most
    count = whole_number("choose(count=...)", count, is_valid, f"an integer from 1 to {most}")
    depths = [check_map("choose(depths)", depth) for depth in depths]
    size = check_options("choose", (height, width), depths[0].shape, "pyramid", hole_threshold)
    rows, columns = (slice(min(_STRIDE, n) // 2, None, _STRIDE) for n in size)
    pixels = pixel_centers(*size)[rows, columns].reshape(-1, 2)
    depths = _checked("choose", depths, [depth.shape for depth in depths], cameras, target)
    options = {"search": "pyramid", "hole_threshold": float(hole_threshold)}
    return _chosen(Sight(target, pixels, options), depths, list(cameras), count)


@eqx.filter_jit
def _chosen(seen: "Sight", depths: list, cameras: list, count: int) -> Choice:
    def each(depth: Array, camera: PinholeCamera) -> Array:
        view, along, _ = seen(depth, camera)
        return jnp.where(view.mask, along, 0)

    worth, chosen = _over_sources(each, depths, cameras), []
    best, reached = jnp.zeros_like(worth[0]), []
    free = jnp.ones(len(worth), bool)
    for _ in range(count):
        together = jnp.maximum(worth, best[None])
        index = jnp.argmax(jnp.where(free, jnp.sum(together, axis=1), -jnp.inf))
        best, free = together[index], free.at[index].set(False)
        chosen.append(index.astype(jnp.int32))
        reached.append(jnp.mean(best))
    return Choice(jnp.stack(chosen), jnp.stack(reached))


def check_sources(
    caller: str, images: Any, depths: Any, cameras: Any, target: Any
) -> tuple[list[Array], list[Array], list[PinholeCamera], Camera]:
    """Pictures, depths and cameras, as lists; `ValueError` names a fault."""
    _check_lists(caller, images=images, depths=depths, cameras=cameras)
    images = [check_image(f"{caller}(images)", image) for image in images]
    depths = _checked(caller, depths, [image.shape[:2] for image in images], cameras, target)
    return images, depths, list(cameras), target


def _check_lists(caller: str, **lists: Any) -> None:
    expected = "a sequence with an item for each source"
    lengths = {
        name: len(items(f"{caller}({name})", values, expected))
        for name, values in lists.items()
    }
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        name = next(iter(lists))
        raise ValueError(
            f"`{caller}({name})` must have an item for each camera, at least one, "
            f"got lengths {lengths}."
        )


def _checked(
    caller: str, depths: Sequence, shapes: Sequence, cameras: Sequence, target: Any
) -> list[Array]:
    """The depths as arrays of the given shapes, in types that are computed with."""
    depths = [check_source(caller, *each) for each in zip(depths, shapes, strict=True)]
    for camera in cameras:
        check_cameras(caller, camera, target)
    return [depth.astype(working_dtype(depth.dtype)) for depth in depths]


def _over_sources(function: Callable, *lists: Sequence) -> Any:
    """The results, stacked; sources that are alike in all shapes and types share a program."""
    kinds = {str(jax.tree.map(jax.typeof, each)) for each in zip(*lists, strict=True)}
    stack = lambda *leaves: jnp.stack(leaves)
    if len(kinds) == 1:
        stacked = tuple(jax.tree.map(stack, *items) for items in lists)
        in_turn = lambda *each: jax.lax.map(lambda one: function(*one), each)
        return by_platform(*stacked, cpu=in_turn, accelerator=jax.vmap(function))
    results = [function(*each) for each in zip(*lists, strict=True)]
    return jax.tree.map(stack, *results)


class Sight(eqx.Module):
    """What some of a target's pixels see of a source."""

    target: Camera
    pixels: Float[Array, "ray 2"]
    options: dict[str, Any] = eqx.field(static=True)

    def __call__(
        self, depth: Float[Array, "height width"], camera: PinholeCamera
    ) -> tuple[View, Float[Array, " ray"], Float[Array, " ray"]]:
        """The view, the cosine between the source's rays and the target's, and its depth."""
        pixels = self.pixels.astype(depth.dtype)
        view = look(depth, camera, self.target, pixels, **self.options)
        rays, others = per_depth(camera, view.pixels), per_depth(self.target, pixels)
        cosine = jnp.sum(normalize(rays) * normalize(others), axis=-1)
        # No point of the world: its square overflows where a sky is at 1e20.
        at_infinity = view.inverse_depth <= 0
        poses = camera.world_from_camera, self.target.world_from_camera
        axis, away = poses[1][:3, 2], poses[0][:3, 3] - poses[1][:3, 3]
        along, offset = (
            jnp.sum(v * axis[None].astype(v.dtype), axis=-1)
            for v in (rays, away[None].astype(rays.dtype))
        )
        there = along / jnp.where(at_infinity, 1, view.inverse_depth) + offset
        return view, jnp.maximum(cosine, 0), jnp.where(at_infinity, jnp.inf, there)
