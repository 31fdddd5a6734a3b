"""Depth of field: pictures as a lens of finite aperture would take them."""

from jaxfx.dof.accumulate import Accumulation, accumulate
from jaxfx.dof.scatter import scatter


__all__ = ["Accumulation", "accumulate", "scatter"]
