"""Parameters of lenses, cameras and lights from photographs, by nonlinear least squares.

| I want | call |
|---|---|
| the lens that took a photograph | `fit.dof(..., effect="layered")` |
| `gamma` and `epsilon` that make `dof.scatter` look most like a photograph | `fit.dof(...)` |
| the scale and shift of a network's depth, beside the lens | `fit.dof(..., parameters=...)` |
| depth and an all-in-focus image from a focal stack | `fit.focal_stack` |
| the pose of a second photograph | `fit.camera` |
| the colors, positions and directions of lights | `fit.lights` |
| a sun by the edge of its shadow | `fit.lights` with `shadow.MovingShadow`, `loss="squares"` |
| a quick look while arguments are settled | any of them, `max_steps` small, `throw=False` |

Every result has `standard_errors`; `success`, and `doubt`, a sentence, say whether the images
determine what was sought. `loss="squares"` of `fit.dof` is plain least squares, kept for
comparison.
"""

from jaxfx.fit.camera import CameraFit, camera
from jaxfx.fit.dof import DISPARITY_PARAMETERS, LAYERED_PARAMETERS, PARAMETERS, DofFit, dof
from jaxfx.fit.focal_stack import FocalStackFit, focal_stack
from jaxfx.fit.lights import LIGHT_PARAMETERS, LightsFit, lights


__all__ = [
    "DISPARITY_PARAMETERS",
    "LAYERED_PARAMETERS",
    "LIGHT_PARAMETERS",
    "PARAMETERS",
    "CameraFit",
    "DofFit",
    "FocalStackFit",
    "LightsFit",
    "camera",
    "dof",
    "focal_stack",
    "lights",
]
