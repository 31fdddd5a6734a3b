"""Cameras at lights, to make shadow maps with."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._arguments import check_light
from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, check, parameter, whole_number
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import normalize
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.light import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    SphericalHarmonicsLight,
    SpotLight,
)


# Of each face of a cube: the axis that its camera looks along, and its up axis, in world space.
_FACES = (
    ((1, 0, 0), (0, 1, 0)),
    ((-1, 0, 0), (0, 1, 0)),
    ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (0, 1, 0)),
    ((0, 0, -1), (0, 1, 0)),
)


@on_any_mesh
def light_cameras(
    light: Light,
    *,
    map_size: WholeNumber,
    scene_center: Float[ArrayLike, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    scene_radius: Float[ArrayLike, ""] | float = 1.0,
    margin: WholeNumber = 0,
) -> tuple[PinholeCamera | OrthographicCamera, ...]:
    """The cameras to render a light's shadow maps with.

    A directional light has one, orthographic, that takes in a ball around the scene; a spot
    light one, as wide as its cone; a point light six, one per face of a cube; an ambient light
    none, for it has no shadow.

    **Arguments:**

    - `light`: any of the four.
    - `map_size`: static; side of a map, in pixels.
    - `scene_center`, `scene_radius`: the ball that holds the scene, 3 and a scalar, in scene
      units; a directional light's camera is placed two radii before the centre.
    - `margin`: static; pixels by which each map extends beyond the ball, the cone or the
      cube's face on each side. Half a filter's size keeps filters inside a face.

    **Returns:** a tuple of cameras.

    **Raises:** `ValueError` for a `scene_radius` that is not positive, a margin that fills the
    map, or a spot light's cone of pi or more.

    **Gradient:** exact with respect to the light, `scene_center` and `scene_radius`; zero along
    the light's own roll, which is arbitrary, and at a direction of zero.

    **Example:** the six maps of a point light are used side by side; here those of an empty
    scene:

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, PointLight, shadow
    >>> lamp = PointLight([0, -3, 0], color=[1, 1, 1])
    >>> cameras = shadow.light_cameras(lamp, map_size=16, margin=1)
    >>> maps = [jnp.full((16, 16), jnp.inf) for camera in cameras]
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> receivers = shadow.receivers(jnp.ones((8, 8)), camera, cameras)
    >>> visibility = shadow.pcf(jnp.concatenate(maps, axis=1), receivers, size=3)
    >>> len(cameras), visibility.shape
    (6, (8, 8))

    Source: Williams 1978; the cube is that of Greene 1986's environment maps.
    """
    check_light("light_cameras(light)", light)
    map_size = whole_number("light_cameras(map_size=...)", map_size)
    margin = whole_number(
        "light_cameras(margin=...)",
        margin,
        lambda n: 0 <= 2 * n < map_size,
        f"0 or more and below half of `map_size`, which is {map_size}",
    )
    scene_center = parameter("light_cameras(scene_center=...)", scene_center, (3,))
    scene_radius = parameter("light_cameras(scene_radius=...)", scene_radius)
    check("light_cameras(scene_center=...)", scene_center, np.isfinite, "finite")
    check(
        "light_cameras(scene_radius=...)",
        scene_radius,
        lambda v: (v > 0) & (v < np.inf),
        "positive",
    )
    inner = map_size - 2 * margin
    if isinstance(light, AmbientLight | SphericalHarmonicsLight | EnvironmentLight):
        return ()
    if isinstance(light, DirectionalLight):
        forward = normalize(light.direction)
        pose = _pose(scene_center.astype(forward.dtype) - 2 * scene_radius * forward, forward)
        middle = [map_size / 2, map_size / 2]
        return (OrthographicCamera(inner / (2 * scene_radius), middle, pose),)
    if isinstance(light, SpotLight):
        check(
            "light_cameras(light)",
            light.outer_angle,
            lambda v: v < jnp.pi / 2,
            "a spot light whose `outer_angle` is below pi / 2",
        )
        pose = _pose(light.position, normalize(light.direction))
        return (_pinhole(jnp.tan(light.outer_angle), inner, map_size, pose),)
    tangent_of_45_degrees = jnp.ones_like(light.position[0])
    faces = np.asarray(_FACES, light.position.dtype)
    poses = [_pose(light.position, *map(jnp.asarray, face)) for face in faces]
    return tuple(_pinhole(tangent_of_45_degrees, inner, map_size, pose) for pose in poses)


def _pinhole(tangent: Float[Array, ""], inner: int, map_size: int, pose: Any) -> PinholeCamera:
    """The camera whose middle `inner` pixels reach `tangent` per unit of depth to each side."""
    focal, half = inner / (2 * tangent), jnp.full_like(tangent, map_size / 2)
    zero, one = jnp.zeros_like(tangent), jnp.ones_like(tangent)
    rows = [[focal, zero, half], [zero, focal, half], [zero, zero, one]]
    return PinholeCamera(jnp.stack([jnp.stack(row) for row in rows]), pose)


def _pose(
    eye: Float[Array, "3"], forward: Float[Array, "3"], up: Float[Array, "3"] | None = None
) -> Float[Array, "4 4"]:
    """`world_from_camera` at `eye`, looking `forward`, a unit vector.

    Without `up`, the world axis that is most nearly perpendicular to `forward` is up.
    """
    if up is None:
        axis = jnp.argmin(jnp.abs(forward))
        up = (jnp.arange(3) == axis).astype(forward.dtype)
    right = normalize(jnp.cross(forward, up))
    columns = [right, jnp.cross(forward, right), forward, eye.astype(forward.dtype)]
    last = jnp.asarray([[0, 0, 0, 1]], forward.dtype)
    return jnp.concatenate([jnp.stack(columns, axis=1), last])
