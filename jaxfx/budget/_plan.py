"""What a plan is, and how one is chosen: by trying it on the scene that it is for."""

import math
import statistics
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import is_concrete


# Calls after the first of which the median time is taken.
_CALLS = 3


@final
class Plan(eqx.Module):
    """The cheapest way found to an effect's picture within an error. Called like the effect.

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
        """As the effect, whose data these are."""
        return self.recipe(*data)

    def __str__(self) -> str:
        lines = [f"{self.recipe.title}: error {float(self.predicted_error):.3g}"]
        seconds, full = float(self.predicted_seconds), float(self.full_seconds)
        lines[0] += f", {1e3 * seconds:.3g} ms instead of {1e3 * full:.3g} ms"
        return "\n".join([*lines, *(f"- {sentence}" for sentence in self.left_out)])


class Recipe(NamedTuple):
    """A way to make the picture: what is called, and what it leaves out."""

    call: Any
    left_out: str


class Trial(NamedTuple):
    """A recipe, tried: the error that it makes and the time that it takes."""

    recipe: Recipe
    error: float
    seconds: float


def check_call(name: str, max_error: Any, data: Any) -> float:
    """`max_error` as a number; `ValueError` if it is none or the scene can't be looked at."""
    if isinstance(max_error, bool) or not isinstance(max_error, int | float) or max_error < 0:
        raise ValueError(
            f"`{name}(max_error=...)` must be a number, 0 or positive, got {max_error!r}."
        )
    if not is_concrete(data):
        raise ValueError(
            f"`{name}(...)` must be given concrete data, outside `jit`, `grad` and `vmap`: a "
            "plan is made for one scene. The plan itself may be called anywhere."
        )
    return float(max_error)


def timed(call: Any, data: Sequence[Any]) -> tuple[Any, float]:
    """What a recipe gives, and the median seconds of a compiled call."""
    result, times = jax.block_until_ready(call(*data)), []
    for _ in range(_CALLS):
        started = time.perf_counter()
        jax.block_until_ready(call(*data))
        times.append(time.perf_counter() - started)
    return result, statistics.median(times)


def root_mean_square(difference: Float[Array, "..."]) -> float:
    """Of what is finite in both pictures; what is not is the same in both."""
    finite = jnp.isfinite(difference)
    squares = jnp.where(finite, difference, 0).astype(float) ** 2
    return float(jnp.sqrt(jnp.sum(squares) / max(difference.size, 1)))


def tried(
    recipe: Recipe, data: Sequence[Any], reference: Float[Array, "..."], max_error: float
) -> Trial:
    """A recipe's error on this scene and, where that will do, its time."""
    result = recipe.call(*data)
    error = root_mean_square(result - reference)
    seconds = timed(recipe.call, data)[1] if error <= max_error else math.inf
    return Trial(recipe, error, seconds)


def quickest(trials: Sequence[Trial], max_error: float, full_seconds: float) -> Plan:
    """The plan of the quickest trial within the error; one of them must be."""
    within = [trial for trial in trials if trial.error <= max_error]
    best = min(within, key=lambda trial: trial.seconds)
    sentences = [f"{best.recipe.left_out}."] if best.recipe.left_out else []
    for trial in trials:
        if trial is not best and trial.recipe.left_out:
            why = (
                f"its error would be {trial.error:.2g}"
                if trial.error > max_error
                else f"it takes {1e3 * trial.seconds:.3g} ms"
            )
            sentences.append(f"not taken: {trial.recipe.left_out}, for {why}.")
    return plan(best.recipe.call, best.error, best.seconds, full_seconds, sentences)


def plan(
    call: Any, error: float, seconds: float, full: float, sentences: Sequence[str]
) -> Plan:
    """A plan from plain numbers: the error, its seconds, and those of the full effect."""
    numbers = (jnp.asarray(number, float) for number in (error, seconds, full))
    return Plan(call, *numbers, left_out=tuple(sentences))
