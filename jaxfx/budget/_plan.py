"""What a plan is, and how one is chosen: by trying it on the scene that it is for."""

import statistics
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import is_concrete


# Calls after the first of which the median time is taken, fewer if they take so many seconds.
_CALLS, _ENOUGH = 3, 0.5


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


class Trial(NamedTuple):
    """A way to make the picture, tried: what it leaves out, its error and its time."""

    call: Any
    left_out: str
    error: float
    seconds: float


class Part(NamedTuple):
    """The data of a part of a scene, and what of its picture is looked at."""

    data: Sequence[Any]
    core: tuple[slice, ...] = ()


class Search:
    """Ways to make an effect's picture, tried on some parts of a scene or on all of it.

    What the parts say decides which ways are measured on the whole scene, the quickest first.
    The promise rests on that measurement alone.
    """

    def __init__(
        self, effect: Any, data: Sequence[Any], max_error: float, parts: Sequence[Part] = ()
    ):
        self.effect, self.max_error = effect, max_error
        self.whole, self.parts = [Part(data)], parts or [Part(data)]
        self.references, self.seconds = _drawn(effect, self.parts)
        self.trials: list[Trial] = []
        self._in_full = not parts

    def trial(self, call: Any, left_out: str) -> Trial:
        """A way, tried on the parts."""
        self.trials.append(_tried(call, left_out, self.parts, self.references))
        return self.trials[-1]

    def plan(self) -> Plan:
        """The quickest way that is within the error on the whole scene: or else the effect."""
        within = [n for n, trial in enumerate(self.trials) if trial.error <= self.max_error]
        references, full = self.references, self.seconds
        if within and not self._in_full:
            references, full = _drawn(self.effect, self.whole)
        best, chosen = Trial(self.effect, "", 0.0, full), -1
        for n in sorted(within, key=lambda n: self.trials[n].seconds):
            if not self._in_full:
                self.trials[n] = _tried(*self.trials[n][:2], self.whole, references)
            if self.trials[n].error <= self.max_error and self.trials[n].seconds < full:
                best, chosen = self.trials[n], n
                break
        sentences = [f"{best.left_out}."] if best.left_out else []
        for trial in (trial for n, trial in enumerate(self.trials) if n != chosen):
            too_far = trial.error > self.max_error
            error, time = f"errs by {trial.error:.2g}", f"takes {1e3 * trial.seconds:.3g} ms"
            sentences.append(f"not taken: {trial.left_out}: {error if too_far else time}.")
        return plan(best.call, best.error, best.seconds, full, sentences)


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
    """What a call gives, and the median seconds of a compiled one."""
    result, times = jax.block_until_ready(call(*data)), []
    while len(times) < _CALLS and sum(times) < _ENOUGH:
        started = time.perf_counter()
        jax.block_until_ready(call(*data))
        times.append(time.perf_counter() - started)
    return result, statistics.median(times)


def root_mean_square(difference: Float[Array, "..."]) -> float:
    """Of what is finite in both pictures; what is not is the same in both."""
    finite = jnp.isfinite(difference)
    squares = jnp.where(finite, difference, 0).astype(float) ** 2
    return float(jnp.sqrt(jnp.sum(squares) / max(difference.size, 1)))


def plan(
    call: Any, error: float, seconds: float, full: float, sentences: Sequence[str]
) -> Plan:
    """A plan from plain numbers: the error, its seconds, and those of the full effect."""
    numbers = (jnp.asarray(number, float) for number in (error, seconds, full))
    return Plan(call, *numbers, left_out=tuple(sentences))


def _drawn(call: Any, parts: Sequence[Part]) -> tuple[list[Array], float]:
    """The pictures of all parts, and the seconds that they take together."""
    results = [timed(call, part.data) for part in parts]
    # Of a pair it is the picture, and not its coverage.
    first = lambda result: result[0] if isinstance(result, tuple) else result
    pairs = zip(results, parts, strict=True)
    pictures = [first(result)[part.core] for (result, _), part in pairs]
    return pictures, sum(seconds for _, seconds in results)


def _tried(call: Any, text: str, parts: Sequence[Part], references: list[Array]) -> Trial:
    pictures, seconds = _drawn(call, parts)
    pairs = zip(pictures, references, strict=True)
    differences = [(picture - reference).reshape(-1) for picture, reference in pairs]
    return Trial(call, text, root_mean_square(jnp.concatenate(differences)), seconds)
