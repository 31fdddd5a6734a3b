"""What the methods ask of their arguments, and the picture that they compute with."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._checks import check_depth, check_image
from jaxfx._numerics import working_dtype
from jaxfx.dof.scatter import largest_coc
from jaxfx.lens import FocusPlanes, ThinLens


def check_arguments(
    function: str, image: Any, depth: Any, lens: ThinLens | FocusPlanes, max_coc: Any
) -> tuple[Float[Array, "height width channel"], Float[Array, "height width"], float]:
    """The image, its depth and the largest circle of confusion; `ValueError` names a fault."""
    image = check_image(f"{function}(image)", image)
    depth = check_depth(f"{function}(depth)", depth, image.shape[:2])
    max_coc = largest_coc(function, depth, lens) if max_coc is None else max_coc
    if not (isinstance(max_coc, int | float) and 0 < max_coc < math.inf):
        raise ValueError(f"`{function}(max_coc=...)` must be positive, got {max_coc}.")
    return image, depth, float(max_coc)


def check_count(name: str, count: Any) -> int:
    """`count`, a positive Python integer; `ValueError` names it otherwise."""
    if not isinstance(count, int) or count < 1:
        raise ValueError(f"`{name}` must be a positive integer, got {count!r}.")
    return count


class Defocused(NamedTuple):
    """A picture and how far each of its pixels is out of focus, in one working type.

    `defocus` is signed, in pixels, and clamped to the largest circle of confusion. Pixels that
    are `bad`, whose colour is not finite or whose depth is no depth, hold zeros.
    """

    image: Float[Array, "height width channel"]
    defocus: Float[Array, "height width"]
    bad: Bool[Array, "height width"]


def defocused(
    image: Float[Array, "height width channel"],
    depth: Float[Array, "height width"],
    lens: ThinLens | FocusPlanes,
    max_coc: float,
) -> Defocused:
    """The picture that a method computes with."""
    image = image.astype(working_dtype(image.dtype))
    depth = depth.astype(image.dtype)
    bad = jnp.isnan(lens.circle_of_confusion(depth)) | (depth < 0)
    depth = jnp.where(bad, lens.focus_distance.astype(image.dtype), depth)
    defocus = lens.defocus(depth)
    # Not by a clip: at depth 0 the defocus is infinite, and its derivative must be 0.
    inside = (defocus > -max_coc) & (defocus < max_coc)
    defocus = jnp.where(inside, defocus, jnp.where(defocus < 0, -max_coc, max_coc))
    # A lens that is no lens makes every pixel bad.
    defocus = jnp.where(bad, 0, defocus)
    bad |= ~jnp.isfinite(image).all(axis=-1)
    return Defocused(jnp.where(bad[..., None], 0, image), defocus, bad)
