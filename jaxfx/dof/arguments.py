"""Checks of the arguments that all methods share, and the arrays that they compute with.

A pixel whose depth is missing (0, negative or NaN) has no circle of confusion and adds nothing
to other pixels. It shows the sprites that reach it. Where none does, or where a method needs
the pixel's own circle of confusion, it keeps its own colour. `fit` and `budget` use this
module.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._arguments import check_lens
from jaxfx._checks import (
    as_array,
    check_depth,
    check_image,
    check_shape,
    is_concrete,
    number,
    whole_number,
)
from jaxfx._numerics import one_program, working_dtype
from jaxfx.lens import FocusPlanes, Lens, ThinLens


# Weight of a missing pixel's own colour, beside 1 for sprites that cover it. Larger, and filled
# holes keep their colour; 0, and a pixel that no sprite reaches is 0 / 0.
OWN = 1e-3


def check_arguments(
    function: str, image: Any, depth: Any, lens: Any, max_coc: Any
) -> tuple[Float[Array, "height width channel"], Float[Array, "height width"], Any, float]:
    """The image, its depth, a lens for `jax.jit` and the largest circle; or a `ValueError`."""
    image = check_image(f"{function}(image)", image)
    depth = check_depth(f"{function}(depth)", depth, image.shape[:2])
    check_lens(f"{function}(lens)", lens)
    if max_coc is None:
        max_coc = largest_coc(function, depth, lens)
    is_valid = lambda x: 0 < x < math.inf
    max_coc = number(f"{function}(max_coc=...)", max_coc, is_valid)
    return image, depth, compiled(function, lens, depth), max_coc


def check_margin(function: str, margin: Any, depth: Float[Array, "height width"]) -> int:
    """By how many pixels images are larger on each side than what is returned."""
    least = min(depth.shape)
    is_inside = lambda n: n >= 0 and 2 * n < least
    expected = "an integer from 0, less than half the image"
    return whole_number(f"{function}(margin=...)", margin, is_inside, expected)


def without_margin(x: Array, margin: int) -> Array:
    """Height and width, first, without the margin."""
    return x[margin : x.shape[0] - margin, margin : x.shape[1] - margin]


class Sampled(eqx.Module):
    """The circles of confusion of one depth image, by a lens of a class that is not ours."""

    focus_distance: Float[Array, ""]
    signed: Float[Array, "height width"]
    diameter: Float[Array, "height width"]

    def defocus(self, depth: Array) -> Float[Array, "height width"]:
        """Signed diameters of the circles of confusion."""
        return self.signed.astype(depth.dtype)

    def circle_of_confusion(self, depth: Array) -> Float[Array, "height width"]:
        """Diameters of the circles of confusion."""
        return self.diameter.astype(depth.dtype)


def compiled(function: str, lens: Any, depth: Float[Array, "height width"]) -> Any:
    """The lens, if it is ours; else its circles of confusion at this depth as a pytree."""
    if isinstance(lens, ThinLens | FocusPlanes | Sampled):
        return lens
    dtype = working_dtype(depth.dtype)
    focus = as_array(f"{function}(lens.focus_distance)", lens.focus_distance).astype(dtype)
    depth = jnp.where(depth > 0, depth.astype(dtype), focus)
    circles = []
    for method in ("defocus", "circle_of_confusion"):
        name = f"{function}(lens.{method})"
        circles.append(as_array(name, getattr(lens, method)(depth)).astype(dtype))
        check_shape(name, circles[-1], depth.shape)
    return Sampled(focus, *circles)


def largest_coc(function: str, depth: Float[Array, "height width"], lens: Lens) -> float:
    """The largest circle of confusion of concrete data, rounded up, in pixels.

    Rounded to about eight steps an octave, so that near-by lenses share a compiled program.
    """
    largest = largest_of(function, depth, lens)
    if largest is None:
        raise ValueError(
            f"`{function}(max_coc=...)` must be given under `jit`, `grad` and `vmap`, where it "
            "can't be taken from the data: a static diameter in pixels, got None."
        )
    if not math.isfinite(largest):
        raise ValueError(
            f"`{function}(max_coc=...)` must be given where a circle of confusion is not "
            f"finite, got None and a largest circle of {largest}."
        )
    step = 2 ** max(0, math.floor(math.log2(max(largest, 1))) - 2) / 2
    return max(1.0, math.ceil(largest / step) * step)


def largest_of(function: str, depth: Float[Array, "height width"], lens: Lens) -> float | None:
    """The largest circle of confusion that is not NaN, in pixels; None if it is traced."""
    if not is_concrete(depth, lens):
        return None
    with jax.ensure_compile_time_eval():
        working = depth.astype(working_dtype(depth.dtype))
        circles = compiled(function, lens, working).circle_of_confusion(working)
        largest = _largest(circles, depth)
        # A lens that is no pytree hides what it holds.
        return float(largest) if is_concrete(largest) else None


@one_program
def _largest(
    circles: Float[Array, "height width"], depth: Float[Array, "height width"]
) -> Float[Array, ""]:
    """The largest circle of confusion of a pixel whose depth is known; 0 for none."""
    return jnp.max(jnp.where((depth > 0) & ~jnp.isnan(circles), circles, 0))


class Pixels(NamedTuple):
    """An image and its depth in one working type, with masks of the pixels that lack something.

    - `image`: 0 where the colour is not finite.
    - `depth`: that of the focus plane where it is missing.
    - `missing`: the depth is missing. `lost`: the colour is not finite either.
    - `bad`: the depth is known and the colour is not finite, or the circle of confusion is NaN.
    """

    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    missing: Bool[Array, "height width"]
    lost: Bool[Array, "height width"]
    bad: Bool[Array, "height width"]


def pixels(
    image: Float[Array, "height width channel"], depth: Float[Array, "height width"], lens: Lens
) -> Pixels:
    """The image and depth that a method computes with, in float32 at least."""
    image = image.astype(working_dtype(image.dtype))
    depth = depth.astype(image.dtype)
    missing = ~(depth > 0)
    depth = jnp.where(missing, lens.focus_distance.astype(image.dtype), depth)
    colored = jnp.isfinite(image).all(axis=-1)
    image = jnp.where(colored[..., None], image, 0)
    bad = jnp.isnan(lens.circle_of_confusion(depth)) | ~(missing | colored)
    image = jnp.where(bad[..., None], 0, image)
    return Pixels(image, depth, missing, missing & ~colored, bad)


class Defocused(NamedTuple):
    """An image and the defocus of each pixel, in one working type; masks as in `Pixels`.

    `defocus` is in pixels, clamped to the largest circle of confusion, and 0 where it is not
    known.
    """

    image: Float[Array, "height width channel"]
    defocus: Float[Array, "height width"]
    missing: Bool[Array, "height width"]
    lost: Bool[Array, "height width"]
    bad: Bool[Array, "height width"]


def defocused(
    image: Float[Array, "height width channel"],
    depth: Float[Array, "height width"],
    lens: Lens,
    max_coc: float,
) -> Defocused:
    """The image and defocus that a method computes with."""
    image, depth, missing, lost, bad = pixels(image, depth, lens)
    defocus = lens.defocus(depth)
    # Not by a clip: where a defocus is infinite, its derivative must be 0.
    inside = (defocus > -max_coc) & (defocus < max_coc)
    defocus = jnp.where(inside, defocus, jnp.where(defocus < 0, -max_coc, max_coc))
    # A lens with a NaN in it makes every pixel bad.
    defocus = jnp.where(missing | jnp.isnan(lens.defocus(depth)), 0, defocus)
    return Defocused(image, defocus, missing, lost, bad)


def with_own(
    sums: Float[Array, "height width value"],
    image: Float[Array, "height width channel"],
    missing: Bool[Array, "height width"],
) -> Float[Array, "height width value"]:
    """Sums of colours and of weights; missing pixels get their own colour, weighted `OWN`."""
    own = OWN * jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    return sums + jnp.where(missing[..., None], own, 0)
