"""The cheapest settings of an effect within an error: model no more than a scene needs."""

from jaxfx.budget._plan import Plan
from jaxfx.budget.dof import dof
from jaxfx.budget.relight import relight
from jaxfx.budget.reproject import reproject
from jaxfx.budget.shadow import shadow


__all__ = ["Plan", "dof", "relight", "reproject", "shadow"]
