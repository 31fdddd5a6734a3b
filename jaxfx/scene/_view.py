"""Cameras on the host: in float64 NumPy, and the ones a scene is seen with by default."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxfx._arguments import check_camera
from jaxfx._checks import is_concrete, whole_number
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.light import AmbientLight, DirectionalLight
from jaxfx.scene._scene import Scene


def check_size(caller: str, *sides: Any) -> list[int]:
    """Height and width as integers; `ValueError` names `caller` for any other."""
    return [
        whole_number(f"scene.{caller}({name}=...)", side)
        for name, side in zip(("height", "width"), sides, strict=True)
    ]


class View(NamedTuple):
    """A camera in float64: what the backends and the surface lookup share.

    A camera-space point (X, Y, Z) has the pixel of `intrinsics` @ (X, Y, Z), divided by its
    last entry, in perspective; and that of `intrinsics` @ (X, Y, 1) otherwise.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]
    perspective: bool

    @classmethod
    def of(cls, camera: PinholeCamera | OrthographicCamera, caller: str) -> "View":
        """The camera's numbers; `ValueError` names `caller` where they can't be used."""
        name = f"{caller}(camera)"
        check_camera(name, camera)
        if not is_concrete(camera):
            raise ValueError(
                f"`{name}` must be concrete, got a traced camera: scenes are rendered on the "
                "host, outside `jit`, `grad` and `vmap`."
            )
        perspective = isinstance(camera, PinholeCamera)
        if perspective:
            intrinsics = np.asarray(camera.intrinsics, np.float64)
        else:
            intrinsics = np.eye(3)
            intrinsics[[0, 1], [0, 1]] = float(camera.pixels_per_unit)
            intrinsics[:2, 2] = np.asarray(camera.center)
        view = cls(intrinsics, np.asarray(camera.world_from_camera, np.float64), perspective)
        if not (
            np.isfinite(view.intrinsics).all() and np.isfinite(view.world_from_camera).all()
        ):
            raise ValueError(f"`{name}` must be finite, got a camera with other values.")
        if np.linalg.det(intrinsics) == 0:
            raise ValueError(f"`{name}` must have intrinsics with an inverse, got none.")
        return view

    def rays(
        self, height: int, width: int
    ) -> tuple[Float[np.ndarray, "3 pixel"], Float[np.ndarray, "3 pixel"]]:
        """Origins and directions through the pixels' centres, row by row, in camera space.

        A direction's z is 1, so that a ray's parameter is depth.
        """
        plane = np.linalg.inv(self.intrinsics) @ _homogeneous_centers(height, width)
        plane[2] = 1
        if self.perspective:
            return np.zeros_like(plane), plane
        origins = plane.copy()
        origins[2] = 0
        plane[:2] = 0
        return origins, plane

    def to_camera(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "3 point"]:
        """World points in camera space."""
        rotation, eye = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        return rotation.T @ (points - eye).T

    def to_world(self, points: Float[np.ndarray, "3 point"]) -> Float[np.ndarray, "3 point"]:
        """Camera-space points in world space."""
        return self.turn(points) + self.world_from_camera[:3, 3:]

    def turn(self, directions: Float[np.ndarray, "3 point"]) -> Float[np.ndarray, "3 point"]:
        """Camera-space directions in world space."""
        return self.world_from_camera[:3, :3] @ directions


@functools.lru_cache(maxsize=4)
def _homogeneous_centers(height: int, width: int) -> Float[np.ndarray, "3 pixel"]:
    with jax.ensure_compile_time_eval():  # a trace may be under way around us
        centers = np.asarray(pixel_centers(height, width), np.float64).reshape(-1, 2)
    return np.stack([centers[:, 0], centers[:, 1], np.ones(height * width)])


def default_camera(scene: Scene, *, height: int, width: int) -> PinholeCamera:
    """A camera that has the whole scene in its picture, seen from the front and above.

    It looks at the middle of the bounding box, from as near as the scene and a margin allow,
    with y up. A scene with a `viewpoint` of its own is seen from there.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `height`, `width`: image size in pixels.

    **Returns:** a `PinholeCamera`.

    **Raises:** `ValueError` for a size that is not a positive integer.

    **Gradient:** none: this runs on the host.
    """
    height, width = check_size("default_camera", height, width)
    tangents = np.array([width, height]) / min(height, width)
    if scene.viewpoint is not None:
        eye, at, fov = scene.viewpoint
    else:
        at, fov = scene.center, np.radians(35)
        backward = np.array([0.55, 0.4, 1.0]) / np.linalg.norm([0.55, 0.4, 1.0])
        right = np.cross([0, 1, 0], backward)
        right /= np.linalg.norm(right)
        points = (scene.points - at).T
        across = np.abs(np.stack([right, np.cross(backward, right)]) @ points)
        reach = 0.9 * np.tan(fov / 2) * tangents[:, None]
        eye = at + backward * np.max(
            np.maximum(across / reach, scene.radius / 2) + backward @ points
        )
    fov_y = 2 * np.arctan(np.tan(fov / 2) * tangents[1])
    return PinholeCamera.look_at(eye, at, up=[0, 1, 0], fov_y=fov_y, height=height, width=width)


def default_lights(
    camera: PinholeCamera | OrthographicCamera,
) -> tuple[DirectionalLight, DirectionalLight, AmbientLight]:
    """A warm key light over the camera's left shoulder, a cool fill light, and a little more.

    **Arguments:** `camera`: the camera whose axes the lights follow.

    **Returns:** key, fill and ambient light.

    **Raises:** `ValueError` for another type.

    **Gradient:** none: this runs on the host.
    """
    turn = View.of(camera, "scene.default_lights").world_from_camera[:3, :3]
    key = DirectionalLight(turn @ [0.5, 0.7, 0.8], [0.85, 0.8, 0.72])
    fill = DirectionalLight(turn @ [-0.8, 0.2, 0.6], [0.18, 0.2, 0.25])
    return key, fill, AmbientLight([0.12, 0.12, 0.13])
