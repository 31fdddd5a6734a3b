"""The record of a choice of cameras for a new view, which `reproject` and `relight` return."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int


class Choice(NamedTuple):
    """The cameras that `choose` picked for a new view, and what each of them adds.

    - `chosen`: count, integers: indices of the cameras, the most useful first.
    - `worth`: count, in [0, 1]: the mean over the new view's pixels of the worth of the best
      camera chosen so far, `choose` says which worth. Where it no longer grows, more cameras
      show nothing new.
    """

    chosen: Int[Array, " count"]
    worth: Float[Array, " count"]
