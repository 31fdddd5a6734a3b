"""Reprojection within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfx.budget._plan import Plan, Recipe, Trial, check_call, quickest, timed, tried
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.reproject.blend import blend, choose


class Blend(eqx.Module):
    """`reproject.blend` of some of the sources."""

    chosen: tuple[int, ...] = eqx.field(static=True)
    shape: tuple[int, int] | None = eqx.field(static=True)
    title: ClassVar[str] = "reprojection"

    def __call__(self, images: Any, depths: Any, sources: Any, target: Any) -> Any:
        """As the effect."""
        some = lambda values: [values[index] for index in self.chosen]
        return blend(some(images), some(depths), some(sources), target, shape=self.shape)


class _Picture(eqx.Module):
    """The picture of a recipe, without its coverage."""

    blend: Blend

    def __call__(self, *data: Any) -> Any:
        """As the effect."""
        return self.blend(*data)[0]


def reproject(
    images: Sequence[Float[ArrayLike, "height width channel"]],
    depths: Sequence[Float[ArrayLike, "height width"]],
    sources: Sequence[PinholeCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    shape: tuple[int, int] | None = None,
    max_error: int | float,
) -> Plan:
    """The fewest sources within an error of `reproject.blend` of all of them, "pyramid".

    Sources are taken in the order of `reproject.choose`, one more at a time, until the picture
    on this scene is within the error.

    **Arguments:**

    - `images`, `depths`, `sources`: lists, as in `reproject.blend`; pictures height width
      channel, linear radiance, and their depths, height width, scene units.
    - `target`: the camera to see them from.
    - `shape`: static; height and width of the result in pixels, the first picture's by default.
    - `max_error`: root mean square, linear image units, over all pixels and channels; where
      nothing is known the picture is 0.

    **Returns:** a `Plan`, to be called with `images, depths, sources, target`, as many sources
    as there are here; it gives image and alpha, as `reproject.blend` does.

    **Raises:** `ValueError` as `reproject.blend`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice; the plan's picture has that of what it draws.
    """
    data = (images, depths, sources, target)
    max_error = check_call("reproject", max_error, data)
    every = Blend(tuple(range(len(sources))), shape)
    reference, seconds = timed(_Picture(every), data)
    trials = [Trial(Recipe(_Picture(every), ""), 0.0, seconds)]
    count = len(sources)
    order = choose(depths, sources, target, count=count, shape=shape).chosen.tolist()
    for few in range(1, count):
        taken = tuple(sorted(order[:few]))
        others = ", ".join(str(index) for index in sorted(order[few:]))
        recipe = Recipe(_Picture(Blend(taken, shape)), f"sources {others}")
        trials.append(tried(recipe, data, reference, max_error))
        if trials[-1].error <= max_error:
            break
    plan = quickest(trials, max_error, seconds)
    return eqx.tree_at(lambda plan: plan.recipe, plan, plan.recipe.blend)
