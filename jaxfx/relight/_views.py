"""What caches have of the points that a new view shows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxfx._numerics import normalize
from jaxfx._sampling import nearest
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer


Camera = PinholeCamera | OrthographicCamera
Vectors = Float[Array, "height width 3"]
Scalars = Float[Array, "height width"]
_STEEPEST = 8  # tolerances that a surface, however oblique, may be off along the ray
_AWAY = -0.1  # cosine; interpolated normals look away a little at silhouettes


class Points(NamedTuple):
    """The points that the new view shows."""

    known: Bool[Array, "height width"]
    position: Vectors
    depth: Scalars
    to_camera: Vectors


class Found(NamedTuple):
    """What one cache has where it is asked.

    `at` is its flat pixel; `distance` that of its surface, in units of the depth; `detail`
    the pixels that it spends on a square of the surface as large as the point's own depth.
    """

    seen: Bool[Array, "height width"]
    at: Int[Array, "height width"]
    shader: Int[Array, "height width"]
    normal: Vectors
    distance: Scalars
    detail: Scalars

    def read(self, field: Shaped[Array, "rows columns ..."]) -> Shaped[Array, "..."]:
        """One of the cache's images where it is asked."""
        return read(field, self.at)


def read(
    field: Shaped[Array, "rows columns ..."], index: Int[Array, "height width"]
) -> Shaped[Array, "..."]:
    """An image at flat indices, all of them inside."""
    flat = field.reshape(field.shape[0] * field.shape[1], *field.shape[2:])
    return flat.at[index].get(mode="promise_in_bounds")


def points(target: Camera, pixels: Float[Array, "height width 2"], depth: Scalars) -> Points:
    """What a view with this depth shows; where its depth is no number, a point nobody uses."""
    known = (depth > 0) & jnp.isfinite(depth)
    depth = jnp.where(known, depth, 1)
    position = target.unproject(pixels, depth)
    to_camera = target.unproject(pixels, jnp.zeros_like(depth)) - position
    # In lengths of the depth, as below: squares of a far scene's leave float32's range.
    return Points(known, position, depth, normalize(to_camera / depth[..., None]))


def look_up(gbuffer: GBuffer, camera: Camera, points: Points, tolerance: float) -> Found:
    """What a cache has of the points, and which of them it sees: near enough, facing both."""
    height, width = gbuffer.depth.shape
    dtype = points.depth.dtype
    pixels, depth = camera.project(points.position)
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    flat = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)
    index = nearest(flat, jax.lax.stop_gradient(pixels))
    take = lambda field: read(field, index)
    shader, cached = take(gbuffer.shader), take(gbuffer.depth).astype(dtype)
    normal = take(gbuffer.normal).astype(dtype)
    filled = inside & (shader >= 0) & (cached > 0) & jnp.isfinite(cached)
    cached = jnp.where(filled, cached, 1)

    centre = jnp.stack([index % width, index // width], axis=-1).astype(dtype) + 0.5
    offset = points.position - camera.unproject(centre, cached)
    across, along = jnp.abs(_dot(normal, offset)), jnp.abs(depth - cached)
    across = jnp.where(_dot(normal, normal) > 0, across, along)
    distance = jax.lax.stop_gradient(across / jnp.where(filled, depth, 1))
    seen = filled & (distance <= tolerance) & (along <= _STEEPEST * tolerance * depth)
    seen &= _dot(normal, points.to_camera) > _AWAY

    unit = jax.lax.stop_gradient(points.depth)
    to_camera = camera.unproject(centre, jnp.zeros_like(cached)) - points.position
    to_camera = normalize(to_camera / unit[..., None])
    # A cache's normal may be no number where it does not see the point.
    frontal = jnp.maximum(_dot(jnp.where(seen[..., None], normal, 0), to_camera), 0.01)
    detail = frontal * _pixels_per_area(camera, jnp.where(filled, depth, unit), unit)
    return Found(seen, index, shader, normal, distance, detail)


def _pixels_per_area(camera: Camera, depth: Scalars, side: Scalars) -> Scalars:
    """The pixels that a square at `depth`, parallel to the image, covers."""
    if isinstance(camera, OrthographicCamera):
        return (camera.pixels_per_unit.astype(depth.dtype) * side) ** 2
    focal = camera.intrinsics.astype(depth.dtype)
    return focal[0, 0] * focal[1, 1] * (side / depth) ** 2


def _dot(a: Vectors, b: Vectors) -> Scalars:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
