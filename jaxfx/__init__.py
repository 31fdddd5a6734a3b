"""Differentiable image-space effects in JAX.

An image and its depth, or a deep frame buffer, go in; images come out, with true gradients.

The types live here. The effects are the modules `blur`, `dof`, `reproject`, `shadow` and
`relight`; `fit`, `budget`, `metrics` and `tradeoff` work on top of them; `depth` reads depth as
cameras, networks and files give it; `scene`, `exr` and `io` read and write files on the host.
A module is loaded when it is first used, so `import jaxfx; jaxfx.dof.scatter` works and nothing
is loaded in vain.
"""

import importlib
from typing import Any

from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.lens import FocusPlanes, Lens, ThinLens
from jaxfx.light import AmbientLight, DirectionalLight, Light, PointLight, SpotLight
from jaxfx.transfer import Transfer


__version__ = "0.1.0.dev0"

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

_MODULES = frozenset(
    {
        *("blur", "dof", "reproject", "shadow", "relight"),
        *("fit", "budget", "metrics", "tradeoff"),
        *("depth", "scene", "exr", "io"),
    }
)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"jaxfx.{name}")
    raise AttributeError(f"module `jaxfx` has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
