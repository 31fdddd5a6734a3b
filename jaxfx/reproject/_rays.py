"""The view rays of a target camera in the projected space of a source camera.

A line of the world stays a line in (x, y, -1 / z). A point at depth s along the target's pixel
p has the source's homogeneous pixel s m + b. For a pinhole, b is its eye and m = M p, with M
the matrix of the two cameras at infinity. M is kept as its difference from the identity, which
is 0 for two equal cameras: their rays then stay on their pixels, without rounding.

As s grows the point moves along m b_z - b m_z in x and y, and along m_z in -1 / z. This needs
no two points of the line, whose difference has no digits left where one is at the near plane
and the other far away. Lengths are in units of the near plane's depth, which holds the numbers
of any scene within the range of float32.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import inverse
from jaxfx.camera import OrthographicCamera, PinholeCamera


Camera = PinholeCamera | OrthographicCamera
_Point = tuple[Array, Array, Array]


class ViewRays(NamedTuple):
    """Rays in (x, y, -unit / z), and which of them are in the frustum.

    Those that run away from the source have their origin at their far end, and go from t = -1
    to 0; the others from 0 to 1.
    """

    origin: Float[Array, "ray 3"]
    direction: Float[Array, "ray 3"]
    inside: Bool[Array, " ray"]


def view_rays(
    source: PinholeCamera,
    target: Camera,
    pixels: Float[Array, "ray 2"],
    *,
    shape: tuple[int, int],
    unit: Float[Array, ""],
) -> ViewRays:
    """The rays of some target pixels, clipped to the source's frustum beyond a depth `unit`."""
    far, eye = _lines(source, target, pixels, unit)
    begin, end = _clip(far, eye, shape)
    length = _length(far, eye, begin, end)
    # A ray that is none has finite factors: its derivative, 0 times them, is then 0.
    is_ray = (begin < end) & jnp.isfinite(length)
    direction = _direction(far, eye) * jnp.where(is_ray, length, 0)[:, None]
    runs_away = jax.lax.stop_gradient(direction[:, 2]) > 0
    origin = _point(far, eye, jnp.where(is_ray, jnp.where(runs_away, end, begin), 1))
    inside = is_ray & jnp.isfinite(origin + direction).all(axis=-1)
    origin, direction = (jnp.where(inside[:, None], x, 0) for x in (origin, direction))
    return ViewRays(origin, direction, inside)


def _lines(
    source: PinholeCamera, target: Camera, pixels: Array, unit: Array
) -> tuple[_Point, _Point]:
    """What is multiplied by the depth in the target, and what is added: m and b."""
    dtype = pixels.dtype
    lens, turn = (
        source.intrinsics.astype(dtype),
        source.world_from_camera[:3, :3].T.astype(dtype),
    )
    pose = target.world_from_camera.astype(dtype)
    away = (pose[:3, 3] - source.world_from_camera[:3, 3].astype(dtype)) / unit
    x, y = pixels[:, 0], pixels[:, 1]
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    apart = turn @ (pose[:3, :3] - turn.T)
    if isinstance(target, PinholeCamera):
        target_lens = target.intrinsics.astype(dtype)
        apart = ((lens - target_lens) + lens @ apart) @ inverse(target_lens)
        own, eye, plane = (x, y, one), lens @ (turn @ away), (zero, zero)
    else:
        apart = lens @ (apart + jnp.eye(3, dtype=dtype))
        own, eye = (zero, zero, zero), lens @ (turn @ away)
        scale, centre = target.pixels_per_unit.astype(dtype), target.center.astype(dtype)
        plane = (x - centre[0]) / scale / unit, (y - centre[1]) / scale / unit
        x, y = zero, zero
    far_x, far_y, far_z = (
        row[0] * x + row[1] * y + row[2] + its for row, its in zip(apart, own, strict=True)
    )
    near_x, near_y, near_z = (
        row[0] * plane[0] + row[1] * plane[1] + e for row, e in zip(apart, eye, strict=True)
    )
    return (far_x, far_y, far_z), (near_x, near_y, near_z)


def _clip(far: _Point, eye: _Point, shape: tuple[int, int]) -> tuple[Array, Array]:
    """From which target depth to which a line is in the frustum: a r + b >= 0 for each side."""
    height, width = shape
    hold = jax.lax.stop_gradient
    x, y, z = map(hold, far)
    eye_x, eye_y, eye_z = map(hold, eye)
    sides = [
        (x, eye_x),
        (width * z - x, width * eye_z - eye_x),
        (y, eye_y),
        (height * z - y, height * eye_z - eye_y),
        (z, eye_z - 1),
    ]
    begin, end = jnp.zeros_like(x), jnp.full_like(x, jnp.inf)
    for grows, at_eye in sides:
        crossing = -at_eye / jnp.where(grows == 0, 1, grows)
        begin = jnp.where(grows > 0, jnp.maximum(begin, crossing), begin)
        end = jnp.where(grows < 0, jnp.minimum(end, crossing), end)
        end = jnp.where((grows == 0) & (at_eye < 0), -jnp.inf, end)
    return begin, end


def _direction(far: _Point, eye: _Point) -> Float[Array, "ray 3"]:
    """Which way (x, y, -1 / z) of the source changes with the depth in the target."""
    (x, y, z), (eye_x, eye_y, eye_z) = far, eye
    return jnp.stack((x * eye_z - eye_x * z, y * eye_z - eye_y * z, z), axis=-1)


def _length(far: _Point, eye: _Point, begin: Array, end: Array) -> Float[Array, " ray"]:
    """How many times `_direction` lies between two depths of the target; held constant."""
    hold = jax.lax.stop_gradient
    z, eye_z = hold(far[2]), hold(eye[2])
    inverse = 1 / end
    start, stop = z * begin + eye_z, z + inverse * eye_z
    return (1 - begin * inverse) / (jnp.maximum(start, 1) * stop)


def _point(far: _Point, eye: _Point, depth: Array) -> Float[Array, "ray 3"]:
    """(x, y, -1 / z) of the source at a depth of the target, 0 and infinity among them."""
    at_eye = depth == 0
    inverse = 1 / jnp.where(at_eye, 1, depth)
    x, y, z = (jnp.where(at_eye, e, f + inverse * e) for f, e in zip(far, eye, strict=True))
    z = jnp.where(z > 0, z, 1)
    return jnp.stack([x / z, y / z, -jnp.where(at_eye, 1, inverse) / z], axis=-1)
