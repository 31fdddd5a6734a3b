"""Depth of field: pictures as a lens of finite aperture would take them."""

from jaxfx.dof.accumulate import Accumulation, accumulate
from jaxfx.dof.blend import blend
from jaxfx.dof.depth_sorted import depth_sorted
from jaxfx.dof.diffusion import anisotropic_diffusion, implicit_diffusion
from jaxfx.dof.gather import gather
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import scatter
from jaxfx.dof.separable import separable


__all__ = [
    "Accumulation",
    "accumulate",
    "anisotropic_diffusion",
    "blend",
    "depth_sorted",
    "gather",
    "implicit_diffusion",
    "layered",
    "scatter",
    "separable",
]
