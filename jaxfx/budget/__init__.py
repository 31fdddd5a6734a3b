"""The cheapest settings of an effect within an error: model no more than a scene needs.

A plan has its price: the time of two to four renderings at full quality, of which one is the
proof, and, at first, seconds to compile what is tried. It pays where a scene is drawn again and
again: with other lights, in a loop that fits.
"""

from jaxfx.budget._plan import Plan
from jaxfx.budget.accumulate import accumulate
from jaxfx.budget.dof import dof
from jaxfx.budget.relight import relight
from jaxfx.budget.reproject import reproject
from jaxfx.budget.shadow import shadow


__all__ = ["Plan", "accumulate", "dof", "relight", "reproject", "shadow"]
