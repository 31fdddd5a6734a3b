"""The rays of a target camera's pixels, in the coordinates (x, y, -1/z) of another camera.

A line of the world is a line in (x, y, -1/z). The point at depth s of a target pixel p has the
homogeneous pixel s m + b in the other camera. For a pinhole target, m = M p, with M the matrix
between the two image planes at infinity: m is the vanishing point of the ray. b is the eye of
the target. M is stored as its difference from the identity, which is 0 for two equal cameras:
their rays then stay on their pixels, without rounding.

With growing s the point moves along m b_z - b m_z in x and y, and along m_z in -1/z. Two points
of the line are not needed; their difference would have no digits left where one is at the near
plane and the other far away. Lengths are in units of the near plane's depth, which keeps the
numbers of any scene within the range of float32.
"""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import inverse
from jaxfx.camera import Camera, PinholeCamera
from jaxfx.reproject._crossings import Coordinates


class ViewRays(NamedTuple):
    """Rays origin + t direction in (x, y, -unit/z), clipped to the frustum of the camera.

    - `origin`, `direction`: x and y in pixels. Rays that run away from the camera have their
      origin at their far end: t goes from -1 to 0. For the others t goes from 0 to 1.
    - `inside`: whether any of the ray is in the frustum; where not, both are 0.
    """

    origin: Coordinates
    direction: Coordinates
    inside: Bool[Array, " ray"]


def view_rays(
    camera: PinholeCamera,
    target: Camera,
    pixels: Float[Array, "ray 2"],
    *,
    height: int,
    width: int,
    unit: Float[Array, ""],
) -> ViewRays:
    """The rays of some target pixels, clipped to the camera's frustum beyond a depth `unit`."""
    vanishing, eye = _homogeneous_lines(camera, target, pixels, unit)
    begin, end = _clip(vanishing, eye, height, width)
    length = _length(vanishing, eye, begin, end)
    # Outside the frustum all factors are finite: the derivative, 0 times them, is then 0.
    is_ray = (begin < end) & jnp.isfinite(length)
    direction = [x * jnp.where(is_ray, length, 0) for x in _direction(vanishing, eye)]
    runs_away = jax.lax.stop_gradient(direction[2]) > 0
    origin_depth = jnp.where(is_ray, jnp.where(runs_away, end, begin), 1)
    origin = _point_at(vanishing, eye, origin_depth)
    sums = map(jnp.add, origin, direction)
    inside = ft.reduce(jnp.logical_and, map(jnp.isfinite, sums), is_ray)
    origin, direction = jax.tree.map(
        lambda x: jnp.where(inside, x, 0), (origin, tuple(direction))
    )
    return ViewRays(origin, direction, inside)


def _homogeneous_lines(
    camera: PinholeCamera, target: Camera, pixels: Array, unit: Array
) -> tuple[Coordinates, Coordinates]:
    """m and b of the module's docstring, per ray: the target's depth is multiplied by m."""
    dtype = pixels.dtype
    intrinsics, camera_from_world = (
        camera.intrinsics.astype(dtype),
        camera.world_from_camera[:3, :3].T.astype(dtype),
    )
    pose = target.world_from_camera.astype(dtype)
    offset = (pose[:3, 3] - camera.world_from_camera[:3, 3].astype(dtype)) / unit
    x, y = pixels[:, 0], pixels[:, 1]
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    # The rotation between the cameras, less the identity.
    difference = camera_from_world @ (pose[:3, :3] - camera_from_world.T)
    if isinstance(target, PinholeCamera):
        target_intrinsics = target.intrinsics.astype(dtype)
        difference = (intrinsics - target_intrinsics) + intrinsics @ difference
        difference = difference @ inverse(target_intrinsics)
        identity, eye = (x, y, one), intrinsics @ (camera_from_world @ offset)
        plane = (zero, zero)
    else:
        # Rays are parallel: m is the same for all, b depends on the point of the image plane.
        difference = intrinsics @ (difference + jnp.eye(3, dtype=dtype))
        identity, eye = (zero, zero, zero), intrinsics @ (camera_from_world @ offset)
        scale, center = target.pixels_per_unit.astype(dtype), target.center.astype(dtype)
        plane = (x - center[0]) / scale / unit, (y - center[1]) / scale / unit
        x, y = zero, zero
    m_x, m_y, m_z = (
        row[0] * x + row[1] * y + row[2] + same
        for row, same in zip(difference, identity, strict=True)
    )
    b_x, b_y, b_z = (
        row[0] * plane[0] + row[1] * plane[1] + e
        for row, e in zip(difference, eye, strict=True)
    )
    return (m_x, m_y, m_z), (b_x, b_y, b_z)


def _clip(
    vanishing: Coordinates, eye: Coordinates, height: int, width: int
) -> tuple[Array, Array]:
    """The target depths between which lines are in the frustum. Held constant.

    For each plane of the frustum a point is inside where `growth` * depth + `at_eye` >= 0.
    """
    hold = jax.lax.stop_gradient
    x, y, z = map(hold, vanishing)
    eye_x, eye_y, eye_z = map(hold, eye)
    planes = [
        (x, eye_x),
        (width * z - x, width * eye_z - eye_x),
        (y, eye_y),
        (height * z - y, height * eye_z - eye_y),
        (z, eye_z - 1),
    ]
    begin, end = jnp.zeros_like(x), jnp.full_like(x, jnp.inf)
    for growth, at_eye in planes:
        crossing = -at_eye / jnp.where(growth == 0, 1, growth)
        begin = jnp.where(growth > 0, jnp.maximum(begin, crossing), begin)
        end = jnp.where(growth < 0, jnp.minimum(end, crossing), end)
        end = jnp.where((growth == 0) & (at_eye < 0), -jnp.inf, end)
    return begin, end


def _direction(vanishing: Coordinates, eye: Coordinates) -> Coordinates:
    """The direction in (x, y, -1/z) in which points move with growing target depth."""
    (x, y, z), (eye_x, eye_y, eye_z) = vanishing, eye
    return x * eye_z - eye_x * z, y * eye_z - eye_y * z, z


def _length(
    vanishing: Coordinates, eye: Coordinates, begin: Array, end: Array
) -> Float[Array, " ray"]:
    """The multiple of `_direction` between two target depths. Held constant."""
    hold = jax.lax.stop_gradient
    z, eye_z = hold(vanishing[2]), hold(eye[2])
    inverse_end = 1 / end
    z_begin, z_end = z * begin + eye_z, z + inverse_end * eye_z
    return (1 - begin * inverse_end) / (jnp.maximum(z_begin, 1) * z_end)


def _point_at(vanishing: Coordinates, eye: Coordinates, target_depth: Array) -> Coordinates:
    """(x, y, -1/z) at a depth of the target, which may be 0 or infinite."""
    is_eye = target_depth == 0
    reciprocal = 1 / jnp.where(is_eye, 1, target_depth)
    x, y, z = (
        jnp.where(is_eye, e, v + reciprocal * e) for v, e in zip(vanishing, eye, strict=True)
    )
    z = jnp.where(z > 0, z, 1)
    return x / z, y / z, -jnp.where(is_eye, 1, reciprocal) / z
