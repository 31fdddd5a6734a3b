"""The deep frame buffer of a new camera, from those of other cameras."""

import math
from collections.abc import Sequence
from functools import partial, reduce
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, number, option
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import normalize
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.relight._new_view import (
    CacheSamples,
    check_caches,
    check_new_depth,
    look_up,
    points,
)


_AVERAGED = ("color", "ambient", "diffuse", "specular", "roughness")
# In tolerances. A cache whose surface is farther from the point than the nearest cache's by
# more than this shows another surface and is left out. Larger values blur two close surfaces
# into one; 0 would leave one cache per pixel, and rounding would decide which.
_LARGEST_EXCESS = 0.1


class Synthesis(NamedTuple):
    """A synthesized cache, and how many caches each of its pixels comes from.

    - `gbuffer`: the `GBuffer` of the new camera, height width.
    - `views`: height width, integers: how many caches show the pixel's point. Where it is 0 and
      the depth is known, the pixel is a hole: see `fill_holes`.
    """

    gbuffer: GBuffer
    views: Int[Array, "height width"]


@on_any_mesh
def synthesize(
    gbuffers: Sequence[GBuffer],
    cameras: Sequence[PinholeCamera | OrthographicCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    depth: Num[ArrayLike, "height width"],
    tolerance: Number = 0.005,
    angle: Number = 0.5,
    weighting: Literal["equal", "detail"] = "equal",
) -> Synthesis:
    """The cache of the camera `target`, made from the caches of other cameras.

    Relight it as any cache, without rendering the scene again. What no cache sees stays open;
    `fill_holes` fills it.

    **Arguments:**

    - `gbuffers`, `cameras`: the caches, height width each, of any sizes, and their cameras.
    - `target`: the new camera.
    - `depth`: height width, of the new view, scene units along its axis, inf for background; 0,
      negative or NaN where it is missing. Take it from the mesh, or warp the caches' depths.
    - `tolerance`: static; a ratio of the depth. It must cover the error of the depths.
    - `angle`: static; radians. Caches whose normals differ by more are not averaged.
    - `weighting`: "equal" is the source's mean; "detail" weighs each cache by the pixels that
      it spends on a unit of the surface, which favours near and frontal cameras.

    **Returns:** a `Synthesis` of `gbuffer` and `views`. Normals are averaged on the sphere; the
    depth is the given one. Holes and background have shader -1 and zeros. A NaN in a cache
    reaches only the pixels that read it.

    **Raises:** `ValueError` where there is no cache, or not one camera for each, or for an
    option out of range.

    **Gradient:** exact with respect to the caches' colours and roughness, and to `depth` as it
    is passed on. With respect to the normals and the cameras, exact for the weights; zero for
    what is visible, and zero along the image, for caches are read at the nearest pixel.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, PinholeCamera, relight
    >>> view = {"up": [0, -1, 0], "fov_y": 0.7, "height": 8, "width": 8}
    >>> old = PinholeCamera.look_at([0, 0, 0], [0, 0, 3], **view)
    >>> new = PinholeCamera.look_at([1, 0, 0], [1, 0, 3], **view)
    >>> ones = jnp.ones((8, 8, 3))
    >>> facing = -ones.at[..., :2].set(0)
    >>> shader, depth = jnp.zeros((8, 8), int), jnp.full((8, 8), 3.0)
    >>> cache = GBuffer(ones, shader, ones, ones, ones, facing, depth, depth / 6)
    >>> gbuffer, views = relight.synthesize([cache], [old], new, depth=depth)
    >>> gbuffer.color.shape, float(views.mean())
    ((8, 8, 3), 0.5)

    Every pixel of the new view is a point in world space. A cache sees it if the surface in the
    cache's own pixel passes through it (their distance, across the surface, is at most
    `tolerance` of the depth) and faces the new camera. The cache with the least distance
    decides the shader; of the others, those are averaged that have that shader, a normal within
    `angle` of its normal, and a distance not larger by more than a tenth of the tolerance.

    It does badly where the caches are coarse: they are read at the nearest pixel, so texture
    finer than a cache's pixels aliases, and two surfaces less than `tolerance` apart are told
    apart only by shader, normal and the distance to each cache's own surface.

    Source: Kim, Lee & Kyung, equations 2 and 3. The tests across the surface, of normal and of
    shader, and the weights, are our own.
    """
    caches = check_caches("synthesize", gbuffers, cameras, target)
    tolerance = number("synthesize(tolerance=...)", tolerance)
    angle = number("synthesize(angle=...)", angle, expected="positive, in radians,")
    option("synthesize(weighting=...)", weighting, ("equal", "detail"))
    depth = check_new_depth("synthesize", depth)
    options = {"tolerance": tolerance, "angle": angle, "weighting": weighting}
    return _synthesize(*caches, target, depth, **options)


@partial(jax.jit, static_argnames=("tolerance", "angle", "weighting"))
def _synthesize(gbuffers, cameras, target, depth, *, tolerance, angle, weighting):
    like = gbuffers[0].depth.dtype
    height, width = depth.shape
    point = points(target, pixel_centers(height, width, depth.dtype), depth)
    samples = [
        look_up(gbuffer, camera, point, tolerance)
        for gbuffer, camera in zip(gbuffers, cameras, strict=True)
    ]
    agrees, shader = _agreement(samples, tolerance, angle)
    is_used = [mask & point.is_known for mask in agrees]
    views = reduce(jnp.add, [mask.astype(jnp.int32) for mask in is_used])
    is_covered = views > 0
    weights = [
        jnp.where(mask, s.detail if weighting == "detail" else jnp.ones_like(s.detail), 0)
        for mask, s in zip(is_used, samples, strict=True)
    ]
    total = jnp.where(is_covered, sum(weights), 1)
    weights = [(weight / total).astype(like) for weight in weights]

    def mean(values):
        """The weighted mean of one image per cache, height width ..."""
        result = jnp.zeros_like(values[0])
        for value, plane in zip(values, weights, strict=True):
            weight = plane.reshape(plane.shape + (1,) * (result.ndim - 2))
            # A value of no weight may be NaN or inf; 0 times it is NaN, in a derivative too.
            result = result + weight * jnp.where(weight > 0, value, 0)
        return result

    def mean_field(name):
        images = (getattr(gbuffer, name).astype(like) for gbuffer in gbuffers)
        return mean([s.read(image) for s, image in zip(samples, images, strict=True)])

    gbuffer = GBuffer(
        shader=jnp.where(is_covered, shader, -1),
        normal=normalize(mean([s.normal.astype(like) for s in samples])),
        depth=depth.astype(like),
        **{name: mean_field(name) for name in _AVERAGED},
    )
    return Synthesis(gbuffer, views)


def _agreement(
    samples: Sequence[CacheSamples], tolerance: float, angle: float
) -> tuple[list[Bool[Array, "height width"]], Int[Array, "height width"]]:
    """Where each cache agrees with the one whose surface is nearest; and the shader of that."""
    distances = [jnp.where(s.is_visible, s.distance, jnp.inf) for s in samples]
    least, shader, normal = distances[0], samples[0].shader, samples[0].normal
    for distance, s in zip(distances[1:], samples[1:], strict=True):
        is_nearer = distance < least
        least = jnp.where(is_nearer, distance, least)
        shader = jnp.where(is_nearer, s.shader, shader)
        normal = jnp.where(is_nearer[..., None], s.normal, normal)
    # Between unit vectors `angle` apart.
    chord = 2 * math.sin(min(angle, math.pi) / 2)
    agrees = [
        s.is_visible
        & (s.shader == shader)
        & (jnp.sum((s.normal - normal) ** 2, axis=-1) <= chord**2)
        & (s.distance <= least + _LARGEST_EXCESS * tolerance)
        for s in samples
    ]
    return agrees, shader
