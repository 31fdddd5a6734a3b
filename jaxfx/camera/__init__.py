"""Cameras: x right, y down, z forward; poses are `world_from_camera`."""

from jaxfx.camera._records import Projection, Rays
from jaxfx.camera.orthographic import OrthographicCamera
from jaxfx.camera.pinhole import PinholeCamera


__all__ = ["Camera", "OrthographicCamera", "PinholeCamera", "Projection", "Rays"]

Camera = PinholeCamera | OrthographicCamera
