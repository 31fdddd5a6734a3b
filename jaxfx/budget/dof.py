"""Depth of field within an error."""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfx._numerics import check_depth, check_image
from jaxfx.budget._octaves import octaves
from jaxfx.budget._plan import Plan, Recipe, Trial, check_call, plan, quickest, timed, tried
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import largest_coc, scatter
from jaxfx.lens import FocusPlanes, ThinLens


# Largest circles to try, in pixels: from one to the next the time falls by a third or more.
_LADDER = tuple(size * 2**octave for octave in range(9) for size in (1.5, 2.0))
# From which size on to try sprites at lower resolutions, in pixels; not below 3 epsilon.
_SPLITS = (8.0, 10.0)


class Nothing(eqx.Module):
    """The picture as it is."""

    title: ClassVar[str] = "depth of field, none"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return jnp.asarray(image)


class Scatter(eqx.Module):
    """`dof.scatter` of circles up to a size."""

    max_coc: float = eqx.field(static=True)
    title: ClassVar[str] = "depth of field by scatter"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return scatter(image, depth, lens, max_coc=self.max_coc)


class Octaves(eqx.Module):
    """Scatter with large sprites at a lower resolution."""

    max_coc: float = eqx.field(static=True)
    split: float = eqx.field(static=True)
    title: ClassVar[str] = "depth of field by scatter, in octaves"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return octaves(jnp.asarray(image), jnp.asarray(depth), lens, self.max_coc, self.split)


class Layered(eqx.Module):
    """`dof.layered` of circles up to a size."""

    max_coc: float = eqx.field(static=True)
    title: ClassVar[str] = "depth of field by layers"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return layered(image, depth, lens, max_coc=self.max_coc)


def dof(
    image: Float[ArrayLike, "height width channel"],
    depth: Float[ArrayLike, "height width"],
    lens: ThinLens | FocusPlanes,
    *,
    max_error: int | float,
    target: Literal["scatter", "layered"] = "scatter",
) -> Plan:
    """The quickest depth of field within an error of `dof.scatter`.

    Where no circle of confusion passes its pixel, nothing is done, and nothing tried. Else the
    effect is drawn once, and cheaper ways are tried on this scene: the picture as it is,
    circles drawn no larger than some size (the smallest that will do is searched by halving),
    and sprites wider than 8 or 10 pixels in octaves: the larger, the lower the resolution. The
    quickest within the error is taken, or else the effect itself.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `target`: the effect that is approached: `dof.scatter` with `gamma=0`, `epsilon=2` and
      exact kernels, or `dof.layered`, from one layer.

    **Returns:** a `Plan`, to be called with `image, depth, lens`, of this scene or of others
    with no larger circles: those are drawn as large as this scene's largest.

    **Raises:** `ValueError` for a wrong shape, a negative `max_error`, an unknown `target` or
    traced data.

    **Gradient:** none through the choice; the plan's picture has that of what it draws.
    """
    max_error = check_call("dof", max_error, (image, depth, lens))
    image = check_image("dof(image)", image)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    if target not in ("scatter", "layered"):
        raise ValueError(f'`dof(target=...)` must be "scatter" or "layered", got {target!r}.')
    widest = float(jnp.nanmax(lens.circle_of_confusion(depth)))
    data = (image, depth, lens)
    if widest <= 1 and target == "scatter":
        why = f"no circle of confusion passes its pixel: the largest is {widest:.2g} pixels."
        return plan(Nothing(), 0.0, 0.0, float("nan"), [f"all, for {why}"])

    largest = largest_coc("dof", depth, lens)
    effect = (Scatter if target == "scatter" else Layered)(largest)
    reference, seconds = timed(effect, data)
    nothing = tried(Recipe(Nothing(), "all blur"), data, reference, max_error)
    trials = [Trial(Recipe(effect, ""), 0.0, seconds), nothing]
    if nothing.error > max_error:
        trials += _smallest_circles(data, reference, largest, max_error)
        for split in _SPLITS:
            if split < largest and target == "scatter":
                text = f"details of sprites wider than {split:g} pixels, at less resolution"
                trials.append(
                    tried(Recipe(Octaves(largest, split), text), data, reference, max_error)
                )
    return quickest(trials, max_error, seconds)


def _smallest_circles(data: Any, reference: Any, largest: float, max_error: float) -> list:
    """Trials of scatter with ever smaller circles, halving the ladder down to the least."""
    sizes = [size for size in _LADDER if size < largest]
    trials, low, high = [], 0, len(sizes)
    while low < high:
        middle = (low + high) // 2
        text = f"what circles of confusion have above {sizes[middle]:g} pixels"
        trials.append(tried(Recipe(Scatter(sizes[middle]), text), data, reference, max_error))
        low, high = (low, middle) if trials[-1].error <= max_error else (middle + 1, high)
    return trials
