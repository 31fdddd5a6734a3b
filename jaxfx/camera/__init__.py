"""Cameras: x right, y down, z forward; poses are `world_from_camera`."""

from jaxfx.camera.orthographic import OrthographicCamera
from jaxfx.camera.pinhole import PinholeCamera


__all__ = ["Camera", "OrthographicCamera", "PinholeCamera"]

Camera = PinholeCamera | OrthographicCamera
