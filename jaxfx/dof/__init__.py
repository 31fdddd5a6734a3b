"""Depth of field: images as a lens of finite aperture would take them.

| I want | call |
|---|---|
| the best result from one image and its depth | `layered` |
| the same where a second layer of depth is known | `layered(behind=(image, depth))` |
| a guess of that layer, from the image itself | `peel` |
| blades, rounded blades or an anamorphic lens | `Iris`, of `scatter`, `layered`, `accumulate` |
| a preview in a tenth of the time, 0.5 to 11 dB below `layered` | `separable` |
| a lens found from an image | `fit.dof(..., effect="layered")` |
| parameters fitted to a scene, second derivatives | `scatter` |
| the multi-pass reference of a renderer | `accumulate` |
| methods of the literature, for comparison | `gather`, `blend`, `depth_sorted`, |
| | `anisotropic_diffusion`, `implicit_diffusion` |

All but `accumulate` are called with `(image, depth, lens, max_coc=...)` and give an image,
`peel` an image and its depth.
"""

from jaxfx.dof.accumulate import Accumulation, accumulate
from jaxfx.dof.blend import blend
from jaxfx.dof.depth_sorted import depth_sorted
from jaxfx.dof.diffusion import anisotropic_diffusion, implicit_diffusion
from jaxfx.dof.gather import gather
from jaxfx.dof.iris import Iris
from jaxfx.dof.layered import layered
from jaxfx.dof.peel import peel
from jaxfx.dof.scatter import scatter
from jaxfx.dof.separable import separable


__all__ = [
    "Accumulation",
    "Iris",
    "accumulate",
    "anisotropic_diffusion",
    "blend",
    "depth_sorted",
    "gather",
    "implicit_diffusion",
    "layered",
    "peel",
    "scatter",
    "separable",
]
