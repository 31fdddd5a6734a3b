"""The arguments of `fit.dof`, read and checked."""

import math
from collections.abc import Collection
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxfx._arguments import check_lens
from jaxfx._checks import check, check_depth, check_image, check_shape, items, option, parameter
from jaxfx._numerics import one_program
from jaxfx.dof.iris import Iris
from jaxfx.dof.sprites import POINT_RADIUS
from jaxfx.fit._lens_model import DISPARITY, IRIS, LENS, Effect, Images, Values
from jaxfx.fit._lens_residual import Tone
from jaxfx.lens import ThinLens


# The parameters that are sought by default.
PARAMETERS = {"scatter": (*LENS, "gamma", "epsilon"), "layered": (*LENS, "threshold")}

# Pixels that share a photograph's largest value, from which on it is taken for saturated. Noise
# makes such values differ; eight bits may repeat one a few times.
_PLATEAU = 8

Loss = Literal["robust", "squares"]
Exposure = Literal["free", "equal"]
_OPTIONS = {"effect": Effect, "loss": Loss, "tone": Tone, "exposure": Exposure}


def options(**given: Any) -> None:
    """`ValueError` for an option that is none of the choices."""
    for name, value in given.items():
        option(f"dof({name}=...)", value, get_args(_OPTIONS[name]))


def images(
    reference: Any, image: Any, depth: Any, lens: Any, behind: Any, weights: Any
) -> tuple[Images, tuple[ThinLens, ...]]:
    """The images, checked, in the type of `image`, and their lenses."""
    image = check_image("dof(image)", image)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    references = _references(reference, image)
    check("dof(image)", image, np.isfinite, "finite")
    check("dof(depth)", depth, lambda v: (v > 0).any(), "known somewhere")
    lenses = tuple(lens) if isinstance(lens, list | tuple) else (lens,)
    is_positive, expected = lambda v: v > 0, "positive to start a search"
    for start in lenses:
        if not isinstance(start, ThinLens):
            raise ValueError(f"`dof(lens)` must be a ThinLens, got {type(start).__name__}.")
        check_lens("dof(lens)", start)
        check("dof(lens.aperture)", start.aperture, is_positive, expected)
    if len(lenses) != len(references):
        raise ValueError(
            f"`dof(lens)` must be one for each of {len(references)} photographs, "
            f"got {len(lenses)}."
        )
    if behind is not None:
        behind = _behind(behind, image)
    focal_pixels = jnp.stack([start.focal_pixels.astype(image.dtype) for start in lenses])
    weights = _weights(weights, image)
    return Images(references, image, depth, behind, weights, focal_pixels), lenses


def _references(
    reference: Any, image: Array
) -> Float[Array, "photograph height width channel"]:
    """One photograph or a list of them, stacked, in the type of `image`."""
    is_list = isinstance(reference, list | tuple) and all(np.ndim(x) == 3 for x in reference)
    given = [*reference] if is_list else [reference]
    if not given:
        raise ValueError("`dof(reference)` must be at least one photograph, got none.")
    references = []
    for index, value in enumerate(given):
        name = f"dof(reference[{index}])" if is_list else "dof(reference)"
        photograph = check_image(name, value)
        if photograph.shape != image.shape:
            raise ValueError(
                f"`{name}` must have the image's shape {image.shape}, got {photograph.shape}."
            )
        check(name, photograph, np.isfinite, "finite")
        references.append(photograph.astype(image.dtype))
    return jnp.stack(references)


@one_program
def without_saturated(images: Images) -> Images:
    """The images with weight 0 where a photograph is saturated.

    Its sensor had no more to say there, and the effect has: highlights of 50 times white would
    decide alone. A channel is saturated where it has its own largest value and `_PLATEAU`
    pixels share that, unless half of the image does.
    """
    references = images.references
    peak = jnp.max(references, axis=(1, 2), keepdims=True)
    is_peak = references == peak
    count = jnp.sum(is_peak, axis=(1, 2), keepdims=True)
    is_plateau = (count >= _PLATEAU) & (2 * count < references.shape[1] * references.shape[2])
    is_saturated = jnp.any(is_peak & is_plateau, axis=(0, 3))
    return images._replace(weights=jnp.where(is_saturated, 0, images.weights))


def peels(behind: Any) -> bool:
    """Whether the second layer is guessed: `"peel"`, the only word that it may be."""
    return isinstance(behind, str) and bool(option("dof(behind=...)", behind, ("peel",)))


def _behind(behind: Any, image: Array) -> tuple[Array, Array]:
    """The second layer's image, in the type of the first's, and its depth."""
    name, expected = "dof(behind=...)", "a pair of an image and its depth"
    pair = items(name, behind, expected)
    if len(pair) != 2:
        raise ValueError(f"`{name}` must be {expected}, got {len(pair)} items.")
    hidden, depth = pair
    hidden = check_image("dof(behind=...)[0]", hidden)
    check_shape("dof(behind=...)[0]", hidden, image.shape)
    depth = check_depth("dof(behind=...)[1]", depth, image.shape[:2])
    return hidden.astype(image.dtype), depth


def _weights(weights: Any, image: Array) -> Float[Array, "height width"]:
    """The weight of each pixel, in the type of `image`."""
    if weights is None:
        return jnp.ones(image.shape[:2], image.dtype)
    weights = check_depth("dof(weights=...)", weights, image.shape[:2])
    is_weight = lambda v: (np.isfinite(v) & (v >= 0)).all() and (v > 0).any()
    check("dof(weights=...)", weights, is_weight, "finite, 0 or positive, and not all 0")
    return weights.astype(image.dtype)


def start(
    lenses: tuple[ThinLens, ...],
    iris: Iris | None,
    gamma: Any,
    epsilon: Any,
    threshold: Any,
    dtype: DTypeLike,
) -> Values:
    """All parameters where the search starts, checked, in one type."""
    numbers = {
        "gamma": parameter("dof(gamma=...)", gamma),
        "epsilon": parameter("dof(epsilon=...)", epsilon),
        "threshold": parameter("dof(threshold=...)", threshold),
    }
    for name, value in numbers.items():
        check(f"dof({name}=...)", value, lambda v: v >= 0, "0 or positive")
    start = {name: jnp.stack([getattr(lens, name) for lens in lenses]) for name in LENS}
    start |= numbers | {"scale": jnp.ones(()), "shift": jnp.zeros(())}
    if iris is not None:
        start |= {name: getattr(iris, name) for name in IRIS}
    return {name: value.astype(dtype) for name, value in start.items()} | {
        "footprint": jnp.zeros((), dtype)
    }


def check_moves(
    names: Collection[str], lenses: tuple[ThinLens, ...], images: Images, max_coc: Any
) -> None:
    """`ValueError` where a lens is sought that no derivative moves.

    Circles of confusion below a pixel and above `max_coc` are drawn at those sizes: where all
    are, neither aperture nor focus distance changes anything.
    """
    if not set(LENS).intersection(names):
        return
    depths = [images.depth] + ([] if images.behind is None else [images.behind[1]])
    most = math.inf if max_coc is None else max_coc
    for lens in lenses:
        circles = [jnp.where(d > 0, lens.circle_of_confusion(d), jnp.nan) for d in depths]
        circles = jnp.stack(circles)
        if bool(((circles > 2 * POINT_RADIUS) & (circles < most)).any()):
            continue
        least, largest = float(jnp.nanmin(circles)), float(jnp.nanmax(circles))
        raise ValueError(
            "`dof(lens)` must start with a circle of confusion between a pixel and `max_coc` "
            "somewhere, for no other has a derivative that could move the aperture or the "
            f"focus distance, got circles from {least:.3g} to {largest:.3g} pixels and "
            f"`max_coc` {max_coc}."
        )


def check_given(max_coc: Any) -> None:
    """`ValueError` where a search under a transform lacks its largest diameter."""
    if max_coc is None:
        raise ValueError(
            "`dof(max_coc=...)` must be given under `jit` and `vmap`, where it can't be taken "
            "from the data: a static diameter in pixels, got None."
        )


def names(
    effect: Effect, parameters: Collection[str] | None, iris: Iris | None
) -> tuple[str, ...]:
    """The names of the parameters to fit: of `PARAMETERS`, `DISPARITY` and an iris' `IRIS`.

    A disc has no rotation.
    """
    default = PARAMETERS[effect]
    choices = default + DISPARITY
    if iris is not None:
        choices += IRIS if iris.blades else IRIS[1:]
    wanted = default if parameters is None else parameters
    names = tuple(name for name in choices if name in wanted)
    if not names or len(names) != len(wanted):
        raise ValueError(
            f"`dof(parameters=...)` must name some of {choices}, got {tuple(wanted)}."
        )
    return names


def ratios(ratios: Any) -> tuple[str, ...]:
    """The parameters of the lenses whose ratios are known, in the order of `LENS`."""
    names = tuple(name for name in LENS if name in ratios)
    if len(names) != len(tuple(ratios)):
        raise ValueError(f"`dof(ratios=...)` must name some of {LENS}, got {tuple(ratios)}.")
    return names
