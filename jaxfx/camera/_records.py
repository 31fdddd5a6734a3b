"""Records that cameras' methods return."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Rays(NamedTuple):
    """Rays through the pixels' centres, in world axes: what `rays` of a camera returns.

    - `origins`: height width 3, in scene units.
    - `directions`: height width 3, unit vectors.
    """

    origins: Float[Array, "height width 3"]
    directions: Float[Array, "height width 3"]


class Projection(NamedTuple):
    """World points in an image: what `project` of a camera returns.

    - `pixels`: `... 2`, (x, y), with centres at +0.5.
    - `depth`: `...`, along the optical axis, in scene units.
    """

    pixels: Float[Array, "... 2"]
    depth: Float[Array, "..."]
