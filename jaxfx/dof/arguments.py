"""What the methods ask of their arguments, and the picture that they compute with.

A pixel whose depth is missing (0, negative or NaN) has no circle of confusion. It has no
share in other pixels. It shows what reaches it; where nothing does, or where a method asks for
the pixel's own circle, it keeps its own colour.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._arguments import check_lens
from jaxfx._checks import as_array, check_depth, check_image, check_shape, is_concrete, number
from jaxfx._numerics import working_dtype
from jaxfx.lens import FocusPlanes, Lens, ThinLens


# What its own colour weighs in a pixel without a circle, beside 1 for neighbours all about it.
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


class Sampled(eqx.Module):
    """What a lens that is not ours makes of one depth image, whatever depth is asked for."""

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
    """The lens if it is ours; else what it says of this depth, since it may be any object."""
    if isinstance(lens, ThinLens | FocusPlanes | Sampled):
        return lens
    dtype = working_dtype(depth.dtype)
    focus = as_array(f"{function}(lens.focus_distance)", lens.focus_distance).astype(dtype)
    depth = jnp.where(depth > 0, depth.astype(dtype), focus)
    found = []
    for method in ("defocus", "circle_of_confusion"):
        name = f"{function}(lens.{method})"
        found.append(as_array(name, getattr(lens, method)(depth)).astype(dtype))
        check_shape(name, found[-1], depth.shape)
    return Sampled(focus, *found)


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
    """The largest circle that is a number, inside of another trace as well; None if traced."""
    if not is_concrete(depth, lens):
        return None
    with jax.ensure_compile_time_eval():
        working = depth.astype(working_dtype(depth.dtype))
        circles = compiled(function, lens, working).circle_of_confusion(working)
        largest = jnp.max(jnp.where((depth > 0) & ~jnp.isnan(circles), circles, 0))
        # A lens that is no pytree hides what it holds.
        return float(largest) if is_concrete(largest) else None


class Pixels(NamedTuple):
    """Pixels in one working type, and which of them are no pixels.

    - `image`: zero where a colour is not finite.
    - `depth`: that of the focus plane where it is missing.
    - `missing`: the pixels without a depth. `lost`: those of them without a colour as well.
    - `bad`: all others without a colour; and all where the lens is no lens.
    """

    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    missing: Bool[Array, "height width"]
    lost: Bool[Array, "height width"]
    bad: Bool[Array, "height width"]


def pixels(
    image: Float[Array, "height width channel"], depth: Float[Array, "height width"], lens: Lens
) -> Pixels:
    """The picture that a method computes with, in float32 at least."""
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
    """A picture and how far each of its pixels is out of focus, in one working type.

    `defocus` is signed, in pixels, and clamped to the largest circle of confusion. It is zero
    where it is not known, as `missing` and `bad` of `Pixels` say.
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
    """The picture that a method computes with."""
    image, depth, missing, lost, bad = pixels(image, depth, lens)
    defocus = lens.defocus(depth)
    # Not by a clip: where a defocus is infinite, its derivative must be 0.
    inside = (defocus > -max_coc) & (defocus < max_coc)
    defocus = jnp.where(inside, defocus, jnp.where(defocus < 0, -max_coc, max_coc))
    # A lens that is no lens makes every pixel bad.
    defocus = jnp.where(missing | jnp.isnan(lens.defocus(depth)), 0, defocus)
    return Defocused(image, defocus, missing, lost, bad)


def with_own(
    sums: Float[Array, "height width value"],
    image: Float[Array, "height width channel"],
    missing: Bool[Array, "height width"],
) -> Float[Array, "height width value"]:
    """Sums of colours and, last, of weights, with a little of their own to missing pixels."""
    own = OWN * jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    return sums + jnp.where(missing[..., None], own, 0)
