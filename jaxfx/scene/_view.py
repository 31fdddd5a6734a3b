"""A camera in float64 NumPy, as the renderers of this package use it on the host."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxfx._arguments import check_camera
from jaxfx._checks import is_concrete, whole_number
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, PinholeCamera


def check_size(caller: str, *sides: Any) -> list[int]:
    """Height and width as positive integers; `ValueError` names `caller` otherwise."""
    return [
        whole_number(f"scene.{caller}({name}=...)", side)
        for name, side in zip(("height", "width"), sides, strict=True)
    ]


class View(NamedTuple):
    """A camera in float64, for the backends and for the computation of hits.

    With `perspective`, a camera-space point (X, Y, Z) has the homogeneous pixel coordinates
    `intrinsics @ (X, Y, Z)`; without it, `intrinsics @ (X, Y, 1)`.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    world_from_camera: Float[np.ndarray, "4 4"]
    perspective: bool

    @classmethod
    def of(cls, camera: Camera, caller: str) -> "View":
        """The view of a camera; `ValueError` names `caller` for a traced or degenerate one."""
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
            raise ValueError(f"`{name}` must be finite, got NaN or infinite values.")
        if np.linalg.det(intrinsics) == 0:
            raise ValueError(f"`{name}` must have invertible intrinsics, got singular ones.")
        return view

    def rays(
        self, height: int, width: int
    ) -> tuple[Float[np.ndarray, "3 pixel"], Float[np.ndarray, "3 pixel"]]:
        """Origins and directions through the pixels' centres, row by row, in camera space.

        The z of a direction is 1, so that the parameter along a ray is depth.
        """
        at_depth_1 = np.linalg.inv(self.intrinsics) @ _homogeneous_centers(height, width)
        at_depth_1[2] = 1
        if self.perspective:
            return np.zeros_like(at_depth_1), at_depth_1
        origins, directions = at_depth_1.copy(), at_depth_1
        origins[2] = 0
        directions[:2] = 0
        return origins, directions

    def to_camera(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "3 point"]:
        """World points, in camera space."""
        rotation, eye = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        return rotation.T @ (points - eye).T

    def to_world(self, points: Float[np.ndarray, "3 point"]) -> Float[np.ndarray, "3 point"]:
        """Camera-space points, in world space."""
        return self.turn(points) + self.world_from_camera[:3, 3:]

    def turn(self, directions: Float[np.ndarray, "3 point"]) -> Float[np.ndarray, "3 point"]:
        """Camera-space directions, in world space."""
        return self.world_from_camera[:3, :3] @ directions


@functools.lru_cache(maxsize=4)
def _homogeneous_centers(height: int, width: int) -> Float[np.ndarray, "3 pixel"]:
    """The pixels' centres (x, y, 1), row by row; kept for the latest image sizes."""
    with jax.ensure_compile_time_eval():  # The caller may be inside a trace.
        centers = np.asarray(pixel_centers(height, width), np.float64).reshape(-1, 2)
    return np.stack([centers[:, 0], centers[:, 1], np.ones(height * width)])
