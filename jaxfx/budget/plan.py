"""The result of a budget: what to call instead of an effect, and how far it is off."""

from typing import Any, final

import equinox as eqx
from jaxtyping import Array, Float


@final
class Plan(eqx.Module):
    """The quickest recipe found for an effect's image within an error. Called like the effect.

    On the scene that it was made for, its error was measured against the effect itself, and so
    holds there; on another scene it is a guess. `print` shows what was left out, and why.

    - `recipe`: what is called with the data, images of height width; a pytree.
    - `predicted_error`: a scalar, the root mean square difference to the effect at full
      quality, in linear image units.
    - `predicted_seconds`, `full_seconds`: scalars, of a compiled call, and of one at full
      quality, where that was timed; NaN where it was not.
    - `left_out`: sentences.
    """

    recipe: Any
    predicted_error: Float[Array, ""]
    predicted_seconds: Float[Array, ""]
    full_seconds: Float[Array, ""]
    left_out: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, *data: Any) -> Any:
        """The image of the recipe, from the data that the effect takes."""
        return self.recipe(*data)

    def __str__(self) -> str:
        lines = [f"{self.recipe.title}: error {float(self.predicted_error):.3g}"]
        seconds, full = float(self.predicted_seconds), float(self.full_seconds)
        lines[0] += f", {1e3 * seconds:.3g} ms instead of {1e3 * full:.3g} ms"
        return "\n".join([*lines, *(f"- {sentence}" for sentence in self.left_out)])
