"""The results of a camera's methods that hold two things."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Rays(NamedTuple):
    """The rays through the pixels' centres, in the world's axes.

    - `origins`: height width 3, in scene units.
    - `directions`: height width 3, unit vectors.
    """

    origins: Float[Array, "height width 3"]
    directions: Float[Array, "height width 3"]


class Projection(NamedTuple):
    """Where a camera shows world points.

    - `pixels`: `... 2`, (x, y), with centres at +0.5.
    - `depth`: `...`, along the optical axis, in scene units.
    """

    pixels: Float[Array, "... 2"]
    depth: Float[Array, "..."]
