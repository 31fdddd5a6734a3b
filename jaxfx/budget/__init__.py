"""The quickest recipe for an effect's image within an error, found on the scene it is for.

| I want | call |
|---|---|
| depth of field from an image and its depth | `budget.dof` |
| depth of field by passes through the lens | `budget.accumulate` |
| filtered shadows | `budget.shadow` |
| an image under many lights | `budget.relight` |
| a new view from many images | `budget.reproject` |

Each returns a `Plan`, which is called like the effect. A plan costs two to four renderings at
full quality, of which one is the proof, and at first seconds to compile the candidates. It pays
where a scene is drawn again and again: under other lights, in a loop that fits. For one image
call the effect.
"""

from jaxfx.budget.accumulate import accumulate
from jaxfx.budget.dof import dof
from jaxfx.budget.plan import Plan
from jaxfx.budget.relight import relight
from jaxfx.budget.reproject import reproject
from jaxfx.budget.shadow import shadow


__all__ = ["Plan", "accumulate", "dof", "relight", "reproject", "shadow"]
