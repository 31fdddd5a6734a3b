"""The cheapest settings of an effect within an error: model no more than a scene needs.

A plan has its price. On a picture of 512 x 384 it takes 2 to 16 seconds to find, nearly all of
them to compile what is tried; once that is compiled, the time of 7 to 33 renderings at full
quality. It pays where a scene is drawn again and again: with other lights, in a loop that fits.
"""

from jaxfx.budget._plan import Plan
from jaxfx.budget.accumulate import accumulate
from jaxfx.budget.dof import dof
from jaxfx.budget.relight import relight
from jaxfx.budget.reproject import reproject
from jaxfx.budget.shadow import shadow


__all__ = ["Plan", "accumulate", "dof", "relight", "reproject", "shadow"]
