"""Reprojection within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_image, parameter, whole_number
from jaxfx._numerics import safe_divide, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.budget._search import Search, check_call
from jaxfx.budget._tiles import Blocks, allowed, blocks, spend, sums, tile_of
from jaxfx.budget.plan import Plan
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.reproject.arguments import check_images
from jaxfx.reproject.blend import blend
from jaxfx.reproject.view import trace_with_angle


_OPTIONS = {"search": "pyramid", "hole_threshold": 0.1}
# What a pixel that no source shows any more adds to the squared error, in squared image units:
# so much that it is never left out, since a plan keeps the coverage.
_LOST = 1e30

# The bounds on the steps of a ray that are compared: multiples of this part of the most that
# any takes. More bounds take longer to compare.
_BOUNDS = 8


class Samples(NamedTuple):
    """What rays from the target's pixels show of their sources.

    - `pixel`: the index of the pixel, row by row; one past the last for a ray that fills a
      block.
    - `color`: the source's color there.
    - `mask`: whether the ray shows a surface.
    - `along`: cosine of the angle at which the source's ray meets it.
    - `z`: depth in the target's camera, in scene units.
    - `steps`: steps of the ray's traversal.
    """

    pixel: Int[Array, " ray"]
    color: Float[Array, "ray channel"]
    mask: Bool[Array, " ray"]
    along: Float[Array, " ray"]
    z: Float[Array, " ray"]
    steps: Int[Array, " ray"]


class Everything(eqx.Module):
    """`reproject.blend` of all sources."""

    height: int | None = eqx.field(static=True)
    width: int | None = eqx.field(static=True)
    title: ClassVar[str] = "reprojection"

    def __call__(self, images: Any, depths: Any, cameras: Any, target: Any) -> Any:
        """The image and alpha, as `reproject.blend` gives them."""
        return blend(images, depths, cameras, target, height=self.height, width=self.width)


class Blend(eqx.Module):
    """`reproject.blend` with each source in some tiles only, and a bound on the steps of rays.

    - `parts`: the pixels for which each source is drawn.
    - `shape`: height and width of the result, in pixels.
    """

    parts: tuple[Blocks, ...]
    shape: tuple[int, int] = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True, default=None)
    title: ClassVar[str] = "reprojection, tile by tile"

    def __call__(self, images: Any, depths: Any, cameras: Any, target: Any) -> Any:
        """Image and alpha, called like `reproject.blend`."""
        parts = _chosen(self.parts, images, depths, cameras)
        samples = _sampled(parts, target, self.shape, self.max_steps)
        color, is_known = _blended(samples, self.shape[0] * self.shape[1])
        alpha = is_known.astype(color.dtype)
        return color.reshape(*self.shape, -1), alpha.reshape(self.shape)


def reproject(
    images: Sequence[Float[ArrayLike, "height width channel"]],
    depths: Sequence[Num[ArrayLike, "height width"]],
    cameras: Sequence[PinholeCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    height: WholeNumber | None = None,
    width: WholeNumber | None = None,
    max_error: Number,
) -> Plan:
    """The fewest rays within an error of `reproject.blend` of all sources.

    For a new view of a scene from many images. A plan is for one target; where it leaves out
    sources, those need not be rendered.

    **Arguments:**

    - `images`, `depths`, `cameras`: lists, as in `reproject.blend`; images height width
      channel, linear radiance, and their depths, height width, scene units.
    - `target`: the camera to see them from.
    - `height`, `width`: static; of the result, in pixels, both or none: the first image's by
      default.
    - `max_error`: root mean square, linear image units, over all pixels and channels; where
      nothing is known the image is 0.

    **Returns:** a `Plan`, to be called with `images, depths, cameras, target`, as many sources
    as there are here, alike in size; it gives image and alpha, as `reproject.blend` does.

    **Raises:** `ValueError` as `reproject.blend`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice; the plan's image has that of what it draws.

    **Example:** of two sources that show the same, one is left out.

    >>> import numpy as np
    >>> from jaxfx import PinholeCamera, budget
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> image, depth = np.ones((8, 8, 3), np.float32), np.full((8, 8), 2.0, np.float32)
    >>> data = [image, image], [depth, depth], [camera, camera], camera
    >>> plan = budget.reproject(*data, max_error=0.01)
    >>> float(plan.predicted_error) <= 0.01, plan(*data)[0].shape
    (True, (8, 8, 3))

    The effect is drawn once, each source apart. In every tile of 8 x 8 pixels sources are left
    out one after another, from the one of least weight on, for as long as every pixel that was
    known is known; over the whole image those first that cost the least error. Rays of like
    length are traversed together, as a block takes the steps of its longest. What error is left
    goes to the least bound on steps, of seven, under which every pixel is still known: a ray
    that needs more shows nothing. The rest is drawn and measured against the effect.

    It costs two renderings of all sources, one for the proof and one apart, one by the plan,
    and about one more to compare what is left out.
    """
    data = check_images("reproject", images, depths, cameras, target)
    images, depths, cameras, _ = data
    max_error = check_call("reproject", max_error, data)
    search = Search(Everything(*_sides(height, width)), data, max_error)
    rows, columns = search.whole[1].shape[:2]
    size = (rows, columns)
    uses, steps, most = _needed(*data, size, max_error)
    texts = []
    if not uses.all():
        idle = ", ".join(str(index) for index in np.flatnonzero(~uses.any(axis=1)))
        texts.append(f"{1 - uses.mean():.0%} of the rays{', all of sources ' if idle else ''}")
        texts[-1] += f"{idle}, where others show next to the same"
    if most is not None:
        longer = np.mean(steps[uses] > most)
        texts.append(f"steps of a ray after {most}, which {longer:.2g} of the rays would take")
    if texts and uses.any():
        parts = blocks(uses, list(zip(images, depths, cameras, strict=True)), steps)
        search.trial(Blend(parts, size, most), "; ".join(texts))
    return search.plan()


def _sides(height: Any, width: Any) -> tuple[int, int] | tuple[None, None]:
    """Height and width as positive integers, or None for both."""
    if height is None and width is None:
        return None, None
    return (
        whole_number("reproject(height=...)", height),
        whole_number("reproject(width=...)", width),
    )


def _chosen(parts: Sequence[Blocks], images: Any, depths: Any, cameras: Any) -> list[Any]:
    """The sources of all parts, with their blocks: a program is told no indices of sources."""

    def source(index: int) -> tuple[Array, Array, PinholeCamera]:
        depth = parameter("reproject(depths)", depths[index], None)
        return (
            check_image("reproject(images)", images[index]),
            depth.astype(working_dtype(depth.dtype)),
            cameras[index],
        )

    return [([source(n) for n in part.members], part.item, part.pixels) for part in parts]


def _needed(
    images: Any, depths: Any, cameras: Any, target: Any, size: tuple[int, int], max_error: float
) -> tuple[Bool[np.ndarray, "source pixel"], Int[np.ndarray, "source pixel"], int | None]:
    """The sources that each pixel needs, the steps of their rays, and a bound on the steps.

    Without a bound that saves any, the last is None.
    """
    tile, count = tile_of(size), len(cameras)
    everything = np.ones((count, size[0] * size[1]), bool)
    parts = blocks(everything, list(zip(images, depths, cameras, strict=True)))
    samples = _sampled(_chosen(parts, images, depths, cameras), target, size, None)
    weights = _weights(samples, everything.shape[1])
    source = np.concatenate(
        [np.repeat(np.array(p.members)[np.asarray(p.item)], p.pixels.shape[1]) for p in parts]
    )
    # The last column is of rays that fill a block.
    shares = np.zeros((count, everything.shape[1] + 1))
    steps = np.zeros(shares.shape, np.int32)
    shares[source, samples.pixel], steps[source, samples.pixel] = weights, samples.steps
    # The rank of each source in a tile, the one of the largest weight first.
    place = np.argsort(np.argsort(-sums(shares[:, :-1], tile), axis=1), axis=1)
    tile_of_ray = np.append(tile, 0)[samples.pixel]
    own = place[tile_of_ray, source]
    squares = _squares(samples, own, np.arange(count, -1, -1), size)
    numbers = squares.shape[1] * samples.color.shape[1]
    kept = count - spend(sums(squares, tile), max_error, numbers)
    uses, steps = (place < kept[:, None])[tile].T, steps[:, :-1]

    longest = int(np.max(steps, where=uses, initial=0))
    bounds = np.unique(np.arange(1, _BOUNDS) * longest // _BOUNDS)
    taken = np.where(own < kept[tile_of_ray], samples.steps, np.iinfo(np.int32).max)
    squares = _squares(samples, taken, bounds + 1, size)
    enough = bounds[(bounds > 0) & (squares.sum(axis=1) <= allowed(max_error, numbers))]
    return uses, steps, int(enough[0]) if enough.size else None


@eqx.filter_jit
def _sampled(
    parts: list[Any], target: Any, size: tuple[int, int], max_steps: int | None
) -> Samples:
    """What all rays show, block after block.

    `parts` are those of `_chosen`, `size` is height and width of the result.
    """
    points, shown = pixel_centers(*size).reshape(-1, 2), []
    for members, *of_each in parts:
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)

        def block(item, stacked=stacked):
            source, pixels = item
            image, depth, camera = jax.tree.map(lambda x: x[source], stacked)
            centers = points.at[pixels].get(mode="clip")
            view, along, z = trace_with_angle(
                depth, camera, target, centers, max_steps=max_steps, **_OPTIONS
            )
            color = view.patch.read_colors(image)
            return Samples(pixels, color, view.mask, along, z, view.steps)

        rays = jax.lax.map(block, tuple(of_each))
        shown.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays))
    joined = lambda *leaves: jnp.concatenate([x.astype(leaves[0].dtype) for x in leaves])
    return jax.tree.map(joined, *shown)


@eqx.filter_jit
def _weights(samples: Samples, count: int) -> Float[Array, " ray"]:
    """The weight of each ray in its pixel, as in `reproject.blend`; `count` pixels."""
    z = jnp.where(samples.mask, samples.z, jnp.inf)
    nearest = jnp.full(count, jnp.inf, z.dtype).at[samples.pixel].min(z, mode="drop")
    nearest = nearest.at[samples.pixel].get(mode="clip")
    front = samples.mask & (z <= (1 + _OPTIONS["hole_threshold"]) * nearest)
    return jax.lax.stop_gradient(jnp.where(front, samples.along**8, 0))


@eqx.filter_jit
def _blended(samples: Samples, count: int) -> tuple[Float[Array, "pixel channel"], Array]:
    """The mean color of each pixel, and whether it has one."""
    weight = _weights(samples, count).astype(samples.color.dtype)[:, None]
    color = jnp.where(weight > 0, samples.color, 0) * weight
    both = jnp.concatenate([color, weight], axis=-1)
    both = (
        jnp.zeros((count, both.shape[1]), both.dtype).at[samples.pixel].add(both, mode="drop")
    )
    weights = jnp.broadcast_to(both[:, -1:], (count, both.shape[1] - 1))
    return safe_divide(both[:, :-1], weights), weights[:, 0] > 0


def _squares(
    samples: Samples, place: np.ndarray, kept: np.ndarray, size: tuple[int, int]
) -> Float[np.ndarray, "level pixel"]:
    """The squared error of each pixel where rays of `place` below each of `kept` are drawn."""
    places, levels = jnp.asarray(place, jnp.int32), jnp.asarray(kept, jnp.int32)
    return np.asarray(_errors(samples, places, levels, size[0] * size[1]), np.float64)


@eqx.filter_jit
def _errors(samples: Samples, place: Array, kept: Array, count: int) -> Array:
    """As `_squares`, level pixel."""
    color, is_known = _blended(samples, count)

    def square(kept):
        fewer = samples._replace(mask=samples.mask & (place < kept))
        without, is_shown = _blended(fewer, count)
        lost = jnp.where(is_known & ~is_shown, _LOST, 0)
        return jnp.sum((without - color) ** 2, axis=-1) + lost

    return jax.lax.map(square, kept)
