"""Differentiable image-space effects in JAX.

An image and its depth, or a deep frame buffer, in; pictures out; true gradients throughout.
Types live here; effects live in their modules: `jaxfx.dof`. The host side, `jaxfx.scene` and
`jaxfx.exr`, is imported when it is asked for.
"""

from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer, Transfer
from jaxfx.lens import FocusPlanes, Lens, ThinLens
from jaxfx.light import AmbientLight, DirectionalLight, Light, PointLight, SpotLight


__all__ = [
    "AmbientLight",
    "Camera",
    "DirectionalLight",
    "FocusPlanes",
    "GBuffer",
    "Lens",
    "Light",
    "OrthographicCamera",
    "PinholeCamera",
    "PointLight",
    "SpotLight",
    "ThinLens",
    "Transfer",
]
