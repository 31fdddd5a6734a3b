"""What a plan is, and how one is chosen: by trying it on the scene that it is for."""

import functools
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete, number


# How far a way may err on parts of a scene to be measured on all of it: first the quickest that
# may be within the error there, then, if it is not, one that has more room.
_ROOMS = (1.25, 1.0, 0.75)
# A way that takes so many times as long as the effect is not drawn on further parts.
_SLOW = 1.5
# The programs that were called before, and so are compiled. Kept whole: the hash of a structure
# does not tell static fields apart.
_called: set[Any] = set()


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


class Part(NamedTuple):
    """A part of a scene, a small scene of its own, and the share that it stands for."""

    data: Sequence[Any]
    share: float = 1.0


class Trial(NamedTuple):
    """A way to make the picture, and how it went part by part, until it was dropped.

    `squares` are the squared errors, times the parts' shares; `time` is in the effect's.
    """

    call: Any
    left_out: str
    squares: tuple[float, ...]
    time: float

    @property
    def error(self) -> float:
        """At least this."""
        return math.sqrt(sum(self.squares))


class Search:
    """Ways to make an effect's picture, tried on parts of a scene, a few measured on all of it.

    The parts tell which ways are worth a measurement. The promise rests on that alone.
    """

    def __init__(
        self, effect: Any, data: Sequence[Any], max_error: float, parts: Sequence[Part] = ()
    ):
        self.effect, self.data, self.max_error = effect, data, max_error
        self.parts = [(part, *timed(effect, part.data)) for part in parts]
        self.tried: list[Trial] = []
        self.measured: list[Trial] = []

    @functools.cached_property
    def whole(self) -> tuple[Part, Any, float]:
        """All of the scene, what the effect makes of it, and its seconds."""
        return Part(self.data), *timed(self.effect, self.data)

    def trial(self, call: Any, left_out: str) -> Trial:
        """A way, tried on the parts up to where it is too far off or slow; or else measured."""
        if not self.parts:
            return self.measure(call, left_out)
        most = _ROOMS[0] * self.max_error
        self.tried.append(_compared(call, left_out, self.parts, most))
        return self.tried[-1]

    def measure(self, call: Any, left_out: str) -> Trial:
        """A way, measured on the whole scene."""
        self.measured.append(_compared(call, left_out, [self.whole]))
        return self.measured[-1]

    def plan(self) -> Plan:
        """The quickest way that is within the error on the whole scene, or else the effect."""
        for room in _ROOMS:
            might = [trial for trial in self.tried if self._is_better(trial, room)]
            if might:
                quickest = min(might, key=lambda trial: trial.time)
                self.tried = [trial for trial in self.tried if trial is not quickest]
                if self._is_better(self.measure(*quickest[:2])):
                    break
        full = self.whole[2]
        kept = filter(self._is_better, self.measured)
        itself = Trial(self.effect, "", (), 1.0)
        best = min(kept, key=lambda trial: trial.time, default=itself)
        sentences = [f"{best.left_out}."] if best.left_out else []
        for trials, where in ((self.measured, ""), (self.tried, " on parts")):
            for trial in (trial for trial in trials if trial is not best):
                why = f"takes {trial.time:.2g} of the effect's time{where}"
                if trial.error > self.max_error:
                    why = f"errs by {trial.error:.2g}{where}"
                sentences.append(f"not taken: {trial.left_out}: {why}.")
        return plan(best.call, best.error, best.time * full, full, sentences)

    def _is_better(self, trial: Trial, room: float = 1.0) -> bool:
        return trial.error <= room * self.max_error and trial.time < 1


def check_call(name: str, max_error: Any, data: Any) -> float:
    """`max_error` as a number; `ValueError` if it is none or the scene can't be looked at."""
    expected = "a number, 0 or positive"
    max_error = number(f"{name}(max_error=...)", max_error, lambda x: x >= 0, expected)
    if not is_concrete(data):
        raise ValueError(
            f"`{name}(...)` must be given concrete data, outside `jit`, `grad` and `vmap`: a "
            "plan is made for one scene. The plan itself may be called anywhere."
        )
    return max_error


def timed(call: Any, data: Sequence[Any]) -> tuple[Any, float]:
    """The picture that a call gives, and the seconds it takes once it is compiled."""
    leaves, structure = jax.tree.flatten((call, data))
    kinds = [(np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves]
    program = (structure, *kinds)
    if program not in _called:
        jax.block_until_ready(call(*data))
        _called.add(program)
    started = time.perf_counter()
    result = jax.block_until_ready(call(*data))
    seconds = time.perf_counter() - started
    # Of a pair it is the picture, and not its coverage.
    return result[0] if isinstance(result, tuple) else result, seconds


@jax.jit
def mean_square(difference: Float[Array, "..."]) -> Float[Array, ""]:
    """Of what is finite in both pictures; what is not is the same in both."""
    squares = jnp.where(jnp.isfinite(difference), difference, 0).astype(float) ** 2
    return jnp.sum(squares) / max(difference.size, 1)


def plan(
    call: Any, error: float, seconds: float, full: float, sentences: Sequence[str]
) -> Plan:
    """A plan from plain numbers: the error, its seconds, and those of the full effect."""
    numbers = (jnp.asarray(number, float) for number in (error, seconds, full))
    return Plan(call, *numbers, left_out=tuple(sentences))


def _compared(
    call: Any, left_out: str, parts: Sequence[tuple[Part, Any, float]], most: float = math.inf
) -> Trial:
    """A way against the effect, part by part, until it errs by more than `most` or is slow."""
    squares, seconds, of_effect = [], 0.0, 0.0
    for part, reference, took in parts:
        picture, own = timed(call, part.data)
        squares.append(part.share * float(mean_square(picture - reference)))
        seconds, of_effect = seconds + own, of_effect + took
        if math.sqrt(sum(squares)) > most or seconds > _SLOW * of_effect:
            break
    return Trial(call, left_out, tuple(squares), seconds / of_effect)
