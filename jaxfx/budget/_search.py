"""How a plan is chosen: candidates are tried on parts of a scene, a few measured on all of it.

A candidate is anything that is called like the effect, has a `title`, and draws nearly the same
image. Parts tell which candidates are worth a measurement; the error that a plan states is
measured on the whole scene, against the effect.
"""

import functools
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete, number
from jaxfx.budget.plan import Plan


# How far a candidate may err on parts to be measured on the whole scene, in turn, as a ratio to
# the error allowed: parts tell an error only roughly. First the quickest that may be within the
# error; if it is not, the quickest that leaves a margin. Each entry may cost a measurement.
_ALLOWANCES = (1.25, 1.0, 0.75)

# A candidate that takes this many times as long as the effect is not drawn on further parts.
# At 1, chance would end the trial of one that is as quick.
_SLOW = 1.5

# The programs that were called before, and so are compiled. Kept whole: the hash of a structure
# does not tell static fields apart.
_called: set[Any] = set()


class Part(NamedTuple):
    """A part of a scene, itself a small scene, and the share of all that it stands for."""

    data: Sequence[Any]
    share: float = 1.0


class Trial(NamedTuple):
    """A candidate, what it leaves out, and how it went part by part, until it was dropped.

    `squares` are the mean squared errors, times the parts' shares; `time` is a ratio to the
    effect's.
    """

    call: Any
    left_out: str
    squares: tuple[float, ...]
    time: float

    @property
    def error(self) -> float:
        """The root mean square error on the parts drawn: at least that of all of them."""
        return math.sqrt(sum(self.squares))


class Search:
    """The search for the quickest candidate within an error.

    - `effect`, `data`: what is to be replaced, and the scene.
    - `max_error`: root mean square, in linear image units.
    - `parts`: where candidates are tried; without any, each is measured on the whole scene.
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
        """The whole scene, the effect's image of it, and the seconds that took."""
        return Part(self.data), *timed(self.effect, self.data)

    def trial(self, call: Any, left_out: str) -> Trial:
        """Try a candidate on the parts, until it is too far off or too slow."""
        if not self.parts:
            return self.measure(call, left_out)
        most = _ALLOWANCES[0] * self.max_error
        self.tried.append(_compared(call, left_out, self.parts, most))
        return self.tried[-1]

    def measure(self, call: Any, left_out: str) -> Trial:
        """Measure a candidate on the whole scene."""
        self.measured.append(_compared(call, left_out, [self.whole]))
        return self.measured[-1]

    def plan(self) -> Plan:
        """The quickest candidate within the error on the whole scene, or else the effect."""
        for allowance in _ALLOWANCES:
            likely = [trial for trial in self.tried if self._is_better(trial, allowance)]
            if likely:
                quickest = min(likely, key=lambda trial: trial.time)
                self.tried = [trial for trial in self.tried if trial is not quickest]
                if self._is_better(self.measure(*quickest[:2])):
                    break
        full = self.whole[2]
        within = filter(self._is_better, self.measured)
        effect = Trial(self.effect, "", (), 1.0)
        best = min(within, key=lambda trial: trial.time, default=effect)
        sentences = [f"{best.left_out}."] if best.left_out else []
        for trials, where in ((self.measured, ""), (self.tried, " on parts")):
            for trial in (trial for trial in trials if trial is not best):
                why = f"takes {trial.time:.2g} of the effect's time{where}"
                if trial.error > self.max_error:
                    why = f"errs by {trial.error:.2g}{where}"
                sentences.append(f"not taken: {trial.left_out}: {why}.")
        return plan(best.call, best.error, best.time * full, full, sentences)

    def _is_better(self, trial: Trial, allowance: float = 1.0) -> bool:
        return trial.error <= allowance * self.max_error and trial.time < 1


def check_call(name: str, max_error: Any, data: Any) -> float:
    """`max_error` as a number; `ValueError` if it is none, or if the data are traced."""
    expected = "a number, 0 or positive"
    max_error = number(f"{name}(max_error=...)", max_error, lambda x: x >= 0, expected)
    if not is_concrete(data):
        raise ValueError(
            f"`{name}(...)` must be given concrete data, outside `jit`, `grad` and `vmap`: a "
            "plan is made for one scene. The plan itself may be called anywhere."
        )
    return max_error


def timed(call: Any, data: Sequence[Any]) -> tuple[Any, float]:
    """The image of a call, and the seconds it takes once it is compiled."""
    leaves, structure = jax.tree.flatten((call, data))
    kinds = [(np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves]
    program = (structure, *kinds)
    if program not in _called:
        jax.block_until_ready(call(*data))
        _called.add(program)
    started = time.perf_counter()
    result = jax.block_until_ready(call(*data))
    seconds = time.perf_counter() - started
    # Of an image and its coverage, the image.
    return result[0] if isinstance(result, tuple) else result, seconds


@jax.jit
def mean_square(difference: Float[Array, "..."]) -> Float[Array, ""]:
    """The mean square of a difference of images; what is not finite, in both, counts 0."""
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
    """A candidate against the effect, until it errs by more than `most` or is slow.

    `parts` hold the effect's image of each and its seconds.
    """
    squares, seconds, effect_seconds = [], 0.0, 0.0
    for part, reference, took in parts:
        image, own = timed(call, part.data)
        squares.append(part.share * float(mean_square(image - reference)))
        seconds, effect_seconds = seconds + own, effect_seconds + took
        if math.sqrt(sum(squares)) > most or seconds > _SLOW * effect_seconds:
            break
    return Trial(call, left_out, tuple(squares), seconds / effect_seconds)
