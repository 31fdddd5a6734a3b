"""What `synthesize` and `choose` share: their arguments, and how a cache is looked up.

A cache is a G-buffer of an earlier view, with its camera. Every pixel of the new view whose
depth is known is a point in world space. `look_up` projects the points into a cache, reads the
nearest pixel there, and tests whether that pixel shows the same surface.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxfx._arguments import check_camera, check_gbuffer
from jaxfx._checks import check_depth, check_map, items
from jaxfx._numerics import normalize
from jaxfx._sampling import nearest
from jaxfx.camera import Camera, OrthographicCamera
from jaxfx.gbuffer import GBuffer


Vectors = Float[Array, "height width 3"]
Scalars = Float[Array, "height width"]
# A multiple of the tolerance: how much the cached depth may differ from the point's depth in
# the cache. The distance perpendicular to the surface may be one tolerance, so that this bound
# matters only where the cache sees the surface at less than about 7 degrees; there nearly any
# depth satisfies the other bound. Smaller values reject surfaces at grazing angles, larger ones
# accept what lies behind a silhouette.
_LONGEST_ALONG_RAY = 8
# Cosine. A surface whose normal makes less than this with the ray to the new camera faces away.
# Below 0, because interpolated normals face away a little at silhouettes; 0 opens holes there.
_LEAST_COSINE = -0.1
# Cosine. The least value in `detail` of a surface's frontality (the cosine between its normal
# and the direction to the cache's camera), so that every cache's weight is positive.
_LEAST_FRONTALITY = 0.01


class Points(NamedTuple):
    """The visible points of the new view; where `is_known` is false, a stand-in at depth 1.

    `position` is in world space, `depth` in scene units along the new camera's axis,
    `to_camera` the unit vector to the new camera.
    """

    is_known: Bool[Array, "height width"]
    position: Vectors
    depth: Scalars
    to_camera: Vectors


class CacheSamples(NamedTuple):
    """What one cache stores for each point of the new view.

    - `is_visible`: whether the cache sees the point.
    - `pixel`: flat index of the cache's pixel that was read.
    - `shader`, `normal`: of that pixel.
    - `distance`: from the point to the plane through that pixel's surface, as a ratio of the
      point's depth in the cache.
    - `detail`: how finely the cache shows the surface: the number of its pixels on a square of
      the surface whose side is as long as the point's depth in the new view.
    """

    is_visible: Bool[Array, "height width"]
    pixel: Int[Array, "height width"]
    shader: Int[Array, "height width"]
    normal: Vectors
    distance: Scalars
    detail: Scalars

    def read(self, field: Shaped[Array, "rows columns ..."]) -> Shaped[Array, "..."]:
        """One of the cache's images at `pixel`."""
        return _read(field, self.pixel)


def check_caches(
    caller: str, gbuffers: Any, cameras: Any, target: Any
) -> tuple[tuple[GBuffer, ...], tuple[Camera, ...]]:
    """The caches and their cameras; `ValueError` names what is wrong with them or `target`."""
    gbuffers = items(f"{caller}(gbuffers)", gbuffers)
    cameras = items(f"{caller}(cameras)", cameras)
    for name, values in (("gbuffers", gbuffers), ("cameras", cameras)):
        if not values:
            raise ValueError(
                f"`{caller}({name})` must be a sequence of at least one, got none."
            )
    gbuffers = [
        check_gbuffer(f"{caller}(gbuffers[{index}])", gbuffer)
        for index, gbuffer in enumerate(gbuffers)
    ]
    for index, camera in enumerate(cameras):
        check_camera(f"{caller}(cameras[{index}])", camera)
    check_camera(f"{caller}(target)", target)
    if len(gbuffers) != len(cameras):
        raise ValueError(
            f"`{caller}(cameras)` must be one for each cache, got {len(cameras)} for "
            f"{len(gbuffers)}."
        )
    return tuple(gbuffers), tuple(cameras)


def check_new_depth(caller: str, depth: Any) -> Scalars:
    """The new view's depth as a float image; `ValueError` otherwise."""
    depth = check_map(f"{caller}(depth=...)", depth)
    return check_depth(f"{caller}(depth=...)", depth, depth.shape)


def points(target: Camera, pixels: Float[Array, "height width 2"], depth: Scalars) -> Points:
    """The points that the new camera sees at `pixels`, at their depths."""
    is_known = (depth > 0) & jnp.isfinite(depth)
    depth = jnp.where(is_known, depth, 1)
    position = target.unproject(pixels, depth)
    to_camera = target.unproject(pixels, jnp.zeros_like(depth)) - position
    # In units of the depth, as below: squares of a far scene's lengths exceed float32's range.
    return Points(is_known, position, depth, normalize(to_camera / depth[..., None]))


def look_up(gbuffer: GBuffer, camera: Camera, points: Points, tolerance: float) -> CacheSamples:
    """The cache's nearest pixel to each point, and whether that shows the point's surface.

    It does if the point lies within `tolerance` (a ratio of the depth) of the pixel's surface,
    if the depths differ by at most `_LONGEST_ALONG_RAY` times that, and if the surface faces
    the new camera.
    """
    height, width = gbuffer.depth.shape
    dtype = points.depth.dtype
    pixels, depth = camera.project(points.position)
    x, y = pixels[..., 0], pixels[..., 1]
    is_inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    flat = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)
    index = nearest(flat, jax.lax.stop_gradient(pixels))
    at_index = lambda field: _read(field, index)
    shader, cached_depth = at_index(gbuffer.shader), at_index(gbuffer.depth).astype(dtype)
    normal = at_index(gbuffer.normal).astype(dtype)
    is_filled = is_inside & (shader >= 0) & (cached_depth > 0) & jnp.isfinite(cached_depth)
    cached_depth = jnp.where(is_filled, cached_depth, 1)

    center = jnp.stack([index % width, index // width], axis=-1).astype(dtype) + 0.5
    offset = points.position - camera.unproject(center, cached_depth)
    across, along = jnp.abs(_dot(normal, offset)), jnp.abs(depth - cached_depth)
    # Where the cache has no normal, the difference in depth stands for the distance.
    across = jnp.where(_dot(normal, normal) > 0, across, along)
    distance = jax.lax.stop_gradient(across / jnp.where(is_filled, depth, 1))
    is_visible = is_filled & (distance <= tolerance)
    is_visible &= along <= _LONGEST_ALONG_RAY * tolerance * depth
    is_visible &= _dot(normal, points.to_camera) > _LEAST_COSINE

    # The unit of length for `detail`: the point's depth in the new view.
    unit = jax.lax.stop_gradient(points.depth)
    to_camera = camera.unproject(center, jnp.zeros_like(cached_depth)) - points.position
    to_camera = normalize(to_camera / unit[..., None])
    # A cache's normal may be NaN where it does not see the point.
    safe_normal = jnp.where(is_visible[..., None], normal, 0)
    frontality = jnp.maximum(_dot(safe_normal, to_camera), _LEAST_FRONTALITY)
    safe_depth = jnp.where(is_filled, depth, unit)
    detail = frontality * _pixels_on_square(camera, safe_depth, unit)
    return CacheSamples(is_visible, index, shader, normal, distance, detail)


def _read(
    field: Shaped[Array, "rows columns ..."], index: Int[Array, "height width"]
) -> Shaped[Array, "..."]:
    """An image at flat indices, all of them inside."""
    flat = field.reshape(field.shape[0] * field.shape[1], *field.shape[2:])
    return flat.at[index].get(mode="promise_in_bounds")


def _pixels_on_square(camera: Camera, depth: Scalars, side: Scalars) -> Scalars:
    """The pixels that a square of that side at `depth`, parallel to the image, covers."""
    if isinstance(camera, OrthographicCamera):
        return (camera.pixels_per_unit.astype(depth.dtype) * side) ** 2
    focal = camera.intrinsics.astype(depth.dtype)
    return focal[0, 0] * focal[1, 1] * (side / depth) ** 2


def _dot(a: Vectors, b: Vectors) -> Scalars:
    """The scalar product along the last axis, without a reduction over an axis of 3."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
