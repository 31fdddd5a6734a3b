"""Cameras: x right, y down, z forward; poses are `world_from_camera`, 4x4.

| I want | call |
|---|---|
| a perspective camera by its field of view | `PinholeCamera.from_fov` |
| one that looks at a point | `PinholeCamera.look_at` |
| one from OpenCV, COLMAP, Blender, NeRF or OpenGL | `PinholeCamera.from_opencv` and so on |
| parallel rays, for the shadow map of a sun, say | `OrthographicCamera` |
| pixels of world points, and back | `project`, `unproject` |
| the world point that each pixel of a depth image shows | `points` |
| rays to trace | `rays` |
| the view through a point of a lens | `PinholeCamera.through_lens` |
"""

from jaxfx.camera._records import Projection, Rays
from jaxfx.camera.orthographic import OrthographicCamera
from jaxfx.camera.pinhole import PinholeCamera


__all__ = ["Camera", "OrthographicCamera", "PinholeCamera", "Projection", "Rays"]

Camera = PinholeCamera | OrthographicCamera
