"""Target pixels traced into the depth map of a camera: the geometry of `warp` and `blend`.

`jaxfx.fit` uses it for the residual of a pose, `jaxfx.budget` for a plan of rays. The depth map
is converted once, to inverse depth -1/z; from there it is handed down, never up:

1. `_rays.view_rays` turns pixels into rays in (x, y, -1/z) of the camera.
2. `_searches.first_crossing` finds the texel that each ray meets first.
3. `_hit.patch_point` moves the hit to the surface and makes it differentiable.
4. `_hit.edge_aware_patch` gives the texels and weights by which an image is read there.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._numerics import normalize
from jaxfx._platform import kept
from jaxfx.camera import Camera, PinholeCamera
from jaxfx.camera.rigid import per_depth
from jaxfx.reproject._crossings import (
    TOP,
    X_SIDE,
    Y_SIDE,
    Coordinates,
    TexelHit,
    start_time,
)
from jaxfx.reproject._hit import Patch, edge_aware_patch, is_depth_step, patch_point
from jaxfx.reproject._rays import view_rays
from jaxfx.reproject._searches import first_crossing


# Machine epsilons. What a ray's position may be wrong by, relative to its terms. With less,
# surfaces that a ray grazes become holes; with more, the edge of a gap is drawn.
_ROUNDING_STEPS = 64


class View(NamedTuple):
    """What some target pixels show of a camera's image and depth.

    - `pixels`: pixel coordinates (x, y) in the camera's image.
    - `reciprocal_depth`: 1/z in the camera, in 1 / scene units; 0 at infinity. It is the
      inverse depth -1/z with its sign changed.
    - `mask`: whether the pixel shows anything; where not, all weights of `patch` are 0.
    - `patch`: the stencil by which an image of the camera is read there.
    - `steps`: steps of the search.
    """

    pixels: Float[Array, "ray 2"]
    reciprocal_depth: Float[Array, " ray"]
    mask: Bool[Array, " ray"]
    patch: Patch
    steps: Int[Array, " ray"]


@eqx.filter_jit
def trace_pixels(
    depth: Float[Array, "height width"],
    camera: PinholeCamera,
    target: Camera,
    pixels: Float[Array, "ray 2"],
    *,
    search: str,
    hole_threshold: int | float,
    max_steps: int | None = None,
) -> View:
    """What `pixels` of the target show of the depth map that `camera` saw."""
    height, width = depth.shape
    is_known, hold = depth > 0, jax.lax.stop_gradient
    nearest = hold(jnp.min(jnp.where(is_known, depth, jnp.inf)))
    # Half of the nearest depth: the near plane of the frustum, and the unit of lengths below.
    tiny = jnp.finfo(depth.dtype).tiny
    unit = jnp.where(nearest < jnp.inf, jnp.maximum(nearest / 2, tiny), 1)
    # In units of 1 / unit; missing pixels are at +inf, which no ray reaches.
    inverse_depth = jnp.where(is_known, -1 / jnp.where(is_known, depth / unit, 1), jnp.inf)
    rays = view_rays(camera, target, pixels, height=height, width=width, unit=unit)
    hit = first_crossing(
        inverse_depth, rays.origin, rays.direction, search, max_steps, origin_at_end=True
    )

    ray = rays.origin, rays.direction
    # A ray that ends at infinity may meet a surface there, but nothing beyond it.
    is_in_front = hold(rays.origin[2] + hit.time * rays.direction[2]) <= 0
    hit = hit._replace(mask=hit.mask & rays.inside & is_in_front)
    is_behind_gap = _comes_through_gap(hold(inverse_depth), *hold(ray), hit, hole_threshold)
    is_behind_gap, time = kept((is_behind_gap, hit.time))
    hit = hit._replace(time=time)
    point = patch_point(inverse_depth, *ray, hit, hole_threshold, origin_at_end=True)
    x, y, z = kept(point.position)
    column, row = (
        jnp.clip(jnp.floor(v), 0, size - 1).astype(jnp.int32)
        for v, size in ((x, width), (y, height))
    )
    anchor = hit.read(hold(inverse_depth))
    # The stencil of a surface extends into a hole beside it; the surface does not.
    is_visible = hit.mask & ~is_behind_gap & is_known[row, column]
    patch = edge_aware_patch(inverse_depth, x, y, anchor, hole_threshold)
    patch = patch._replace(weights=jnp.where(is_visible[None], patch.weights, 0))
    return kept(View(jnp.stack([x, y], axis=-1), -z / unit, is_visible, patch, hit.steps))


def _comes_through_gap(
    inverse_depth: Array,
    origin: Coordinates,
    direction: Coordinates,
    hit: TexelHit,
    threshold: int | float,
) -> Bool[Array, " ray"]:
    """Whether a ray met its texel through a gap between surfaces, which the camera did not see.

    A gap is a depth step from the texel that the ray leaves to the texel that it hits. A ray
    that is behind the texel where it enters the frustum, or where it leaves a hole, has passed
    a surface that is not in the image.
    """
    height, width = inverse_depth.shape
    back_x = jnp.where(hit.face == X_SIDE, -jnp.sign(direction[0]), 0).astype(jnp.int32)
    back_y = jnp.where(hit.face == Y_SIDE, -jnp.sign(direction[1]), 0).astype(jnp.int32)
    x, y = hit.x.astype(jnp.int32) + back_x, hit.y.astype(jnp.int32) + back_y
    float_type = jnp.finfo(inverse_depth.dtype)
    speed = jnp.maximum(jnp.abs(direction[0]), jnp.abs(direction[1]))
    texels_passed = (hit.time - start_time(direction[2], origin_at_end=True)) * speed
    is_at_start = texels_passed <= _ROUNDING_STEPS * float_type.eps * max(height, width)
    is_at_start = is_at_start & (hit.face != TOP)
    has_previous = (x >= 0) & (x < width) & (y >= 0) & (y < height) & ~is_at_start
    previous = inverse_depth[jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)]
    texel = hit.read(inverse_depth)
    # The nearest that the ray may be: its two terms are rounded, and may cancel.
    travelled = hit.time * direction[2]
    terms = jnp.abs(origin[2]) + jnp.abs(travelled)
    rounding = _ROUNDING_STEPS * float_type.eps * terms + float_type.tiny
    ray = origin[2] + travelled - rounding
    # A baseline search may meet a top from behind; the ray itself then says how far behind.
    before = jnp.where(hit.face == TOP, ray, previous)
    is_gap = (before > texel) & is_depth_step(texel, before, threshold)
    return jnp.where(has_previous & (previous < jnp.inf), is_gap, ray > texel)


class AngledView(NamedTuple):
    """A view, and how each target pixel sees its surface.

    - `view`: as `trace_pixels` returns it.
    - `cosine`: of the angle between the target's ray and the camera's, 0 to 1.
    - `target_depth`: depth of the surface in the target, scene units, inf at infinity.
    """

    view: View
    cosine: Float[Array, " ray"]
    target_depth: Float[Array, " ray"]


def trace_with_angle(
    depth: Float[Array, "height width"],
    camera: PinholeCamera,
    target: Camera,
    pixels: Float[Array, "ray 2"],
    *,
    search: str,
    hole_threshold: int | float,
    max_steps: int | None = None,
) -> AngledView:
    """As `trace_pixels`, with the angle between both cameras' rays and the target's depth."""
    pixels = pixels.astype(depth.dtype)
    view = trace_pixels(
        depth,
        camera,
        target,
        pixels,
        search=search,
        hole_threshold=hole_threshold,
        max_steps=max_steps,
    )
    camera_rays, target_rays = per_depth(camera, view.pixels), per_depth(target, pixels)
    cosine = jnp.sum(normalize(camera_rays) * normalize(target_rays), axis=-1)
    # Computed without a point of the world, whose square overflows for a sky at 1e20.
    is_at_infinity = view.reciprocal_depth <= 0
    camera_pose, target_pose = camera.world_from_camera, target.world_from_camera
    axis, offset = target_pose[:3, 2], camera_pose[:3, 3] - target_pose[:3, 3]
    per_unit, constant = (
        jnp.sum(v * axis[None].astype(v.dtype), axis=-1)
        for v in (camera_rays, offset[None].astype(camera_rays.dtype))
    )
    target_depth = per_unit / jnp.where(is_at_infinity, 1, view.reciprocal_depth) + constant
    target_depth = jnp.where(is_at_infinity, jnp.inf, target_depth)
    return AngledView(view, jnp.maximum(cosine, 0), target_depth)
