"""Parameters of the effects from pictures, by optimistix."""

from jaxfx.fit.camera import CameraFit, camera
from jaxfx.fit.dof import DISPARITY_PARAMETERS, LAYERED_PARAMETERS, PARAMETERS, DofFit, dof
from jaxfx.fit.lights import LIGHT_PARAMETERS, LightsFit, lights
from jaxfx.fit.moving_shadow import MovingShadow


__all__ = [
    "DISPARITY_PARAMETERS",
    "LAYERED_PARAMETERS",
    "LIGHT_PARAMETERS",
    "PARAMETERS",
    "CameraFit",
    "DofFit",
    "LightsFit",
    "MovingShadow",
    "camera",
    "dof",
    "lights",
]
