"""Differentiable image-space effects in JAX.

An image and its depth, or a deep frame buffer (a G-buffer), go in; images come out. Every float
parameter has a true gradient.

| I want | call |
|---|---|
| depth of field of an image and its depth, quickly | `dof.scatter` |
| the same with true occlusion, without numbers to tune | `dof.layered` |
| the reference: many pinhole images, averaged | `dof.accumulate` |
| a Gaussian blur, half-size images | `blur.gaussian`, `blur.downsample` |
| an image from another camera | `reproject.warp`; from several images `reproject.choose` |
| rays against a depth map | `reproject.intersect` |
| shadows from a shadow map | `shadow.pcf`; soft ones, of a large lamp, `shadow.pcss` |
| the same where a shadow map's edges are, at less cost | `shadow.edge_pcf` |
| a G-buffer lit by lights | `relight.render`; by one light `relight.shade` |
| one of many lights edited, at the cost of one | `relight.start`, then its methods |
| indirect light | `scene.transfer`, then `relight.indirect` |
| a lens, a camera or lights found from an image | `fit.dof`, `fit.camera`, `fit.lights` |
| the cheapest settings within an error | `budget` |
| scores and charts | `metrics.psnr`, `metrics.ssim`, `tradeoff` |
| depth from a camera, network or stereo pair, cleaned | `depth` |
| a G-buffer of a mesh | `scene.load`, `scene.gbuffer` |
| files | `io` (PNG, JPEG, depth maps), `exr` (OpenEXR) |

Each package's docstring has such a table, which says what to use for which purpose, and which
methods are baselines kept for comparison. Cameras, lenses, lights and G-buffers are classes of
`jaxfx` itself. A module is loaded when it is first used: `import jaxfx; jaxfx.dof.scatter`
works.
"""

import importlib
from typing import Any

from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.lens import FocusPlanes, Lens, ThinLens
from jaxfx.light import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SphericalHarmonicsLight,
    SpotLight,
)
from jaxfx.transfer import Transfer


__version__ = "0.1.0"

__all__ = [
    "AmbientLight",
    "Camera",
    "DirectionalLight",
    "EnvironmentLight",
    "FocusPlanes",
    "GBuffer",
    "Lens",
    "Light",
    "OrthographicCamera",
    "PinholeCamera",
    "PointLight",
    "SphericalHarmonicsLight",
    "SpotLight",
    "ThinLens",
    "Transfer",
]

_MODULES = frozenset(
    {
        *("blur", "dof", "reproject", "shadow", "relight"),
        *("fit", "budget", "metrics", "tradeoff"),
        *("depth", "scene", "exr", "io", "sharding"),
    }
)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"jaxfx.{name}")
    raise AttributeError(f"module `jaxfx` has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
