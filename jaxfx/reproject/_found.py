"""What a search for the first crossing gives: nothing of it is differentiated."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


# How a ray came to a texel's depth: onto its top, through a border, or it began there.
TOP, X_SIDE, Y_SIDE, START = range(4)


class Found(NamedTuple):
    """Where a ray meets the depth, how, and after how many texels."""

    time: Float[Array, " ray"]
    x: Int[Array, " ray"]
    y: Int[Array, " ray"]
    side: Int[Array, " ray"]
    mask: Bool[Array, " ray"]
    steps: Int[Array, " ray"]
    exhausted: Bool[Array, " ray"]
