"""Parameters of the effects from pictures, by optimistix."""

from jaxfx.fit.dof import PARAMETERS, DofFit, dof


__all__ = ["PARAMETERS", "DofFit", "dof"]
