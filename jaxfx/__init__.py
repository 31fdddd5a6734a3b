"""Differentiable image-space effects in JAX.

An image and its depth, or a deep frame buffer, in; pictures out; true gradients throughout.
Types live here; effects live in their modules: `jaxfx.dof`. The host side, `jaxfx.scene` and
`jaxfx.exr`, is imported when it is asked for.
"""

from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer, Transfer
from jaxfx.lens import FocusPlanes, ThinLens
from jaxfx.light import AmbientLight, DirectionalLight, PointLight, SpotLight


__all__ = [
    "AmbientLight",
    "DirectionalLight",
    "FocusPlanes",
    "GBuffer",
    "OrthographicCamera",
    "PinholeCamera",
    "PointLight",
    "SpotLight",
    "ThinLens",
    "Transfer",
]
