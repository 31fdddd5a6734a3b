"""Nonlinear least squares by any solver of optimistix, one step at a time, every loss kept.

Outside of any transform a search is a Python loop, which shows a bar and ends where it may.
Under `jit` and `vmap` it is a loop of the compiled program, with the same steps and ends.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete
from jaxfx._loops import cond, varying_as, while_loop
from jaxfx._progress import Bar
from jaxfx.fit._levenberg_marquardt import LevenbergMarquardt, Linear, Stages, linearised


Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

# Our own solver has also converged after this many steps in a row that each lower the loss by
# less than this ratio: in float32 rounding hides from its own test that it has arrived. With
# fewer steps or a larger ratio it stops on a slope, with more it wanders about the minimum.
PATIENCE, GAIN = 6, 1e-5


_Item: Any = type(optx.RESULTS.successful)


class Verdict(_Item):
    """One of `optimistix.RESULTS`, equal to it, that prints as a sentence, a success too."""

    def __repr__(self) -> str:
        if self == optx.RESULTS.nonlinear_max_steps_reached:
            return (
                "The search took its maximum number of steps: raise `max_steps`, begin nearer, "
                "or seek fewer parameters."
            )
        return optx.RESULTS[self] or "The search converged."


def verdict(result: optx.RESULTS) -> Any:
    """The `Verdict` that equals one of optimistix' results."""
    (index,) = jax.tree.leaves(result)
    return Verdict(index, optx.RESULTS)


class Auxiliary(NamedTuple):
    """What an objective returns in addition to the residual, without derivatives.

    - `loss`: the mean squared residual.
    - `details`: the second of the pair that a residual function returns, for a report; None
      where it returns the residual alone.
    """

    loss: Float[Array, ""]
    details: Any


class End(NamedTuple):
    """Where a search ended.

    - `losses`: the mean squared residual at the start and after every step; under a transform
      in arrays, which are filled up with NaN.
    - `result`: the verdict of the solver.
    """

    unknowns: Any
    losses: list[Float[Array, "..."]]
    result: optx.RESULTS


def check_success(fitted: Any, function: str, sought: str) -> None:
    """Raise `RuntimeError` where a fit is no success, with its doubt and its losses.

    `function` is the fit's name, `sought` what it was to find.
    """
    if fitted.success:
        return
    losses = fitted.losses
    raise RuntimeError(
        f"`{function}` found no {sought} in {len(losses)} steps, the mean squared residual "
        f"going from {losses[0]:.3g} to {losses[-1]:.3g}: {fitted.doubt} "
        "`throw=False` returns what was reached."
    )


def descend(
    residual: Callable[[Any], Any],
    unknowns: Any,
    *,
    solver: Solver | None,
    max_steps: int,
    bar: Bar,
    patience: Any = PATIENCE,
    gain: Any = GAIN,
    every: int = 1,
    radius: float = 1.0,
) -> End:
    """Search from a start for the least mean square of a residual.

    `residual` is an `equinox.Module` that takes a pytree of numbers in JAX's default type to an
    array of that type, or to a pair: that array, and details that `linear` returns too. Its
    class and its shapes decide whether a program is compiled: searches that differ in the
    numbers alone share one. Without a `solver` it is Levenberg-Marquardt, which has also
    converged when `patience` steps in a row each lower the loss by less than `gain`, a ratio,
    and which computes derivatives once in `every` evaluations; for the others the residual has
    a method `at`, which gives the same. Its first step has the radius that is given. A search
    that leaves the finite numbers ends at the best unknowns before.
    """
    patience = patience if solver is None else max_steps
    solver = _default_solver(every, radius) if solver is None else solver
    fn = _Objective(residual, isinstance(solver, optx.AbstractMinimiser))
    if not is_concrete(residual, unknowns):
        return _descend_in_program(solver, fn, unknowns, max_steps, patience, gain)
    y, state = unknowns, _begin(solver, fn, unknowns)
    losses, lowest, best, waited = [], math.inf, y, 0
    reason = optx.RESULTS.nonlinear_max_steps_reached
    for _ in range(max_steps):
        before = y
        y, state, loss, done, result = _step(solver, fn, y, state)
        losses.append(loss)
        bar.step(mse=f"{float(loss):.3g}")
        waited = waited + 1 if loss > (1 - gain) * lowest else 0
        if loss < lowest:
            lowest, best = float(loss), before
        if done or waited >= patience or result != optx.RESULTS.successful:
            reason = result
            break
    y, loss = _finish(solver, fn, y, state, losses[-1], reason)
    if not math.isfinite(loss):
        y, loss, reason = best, _loss(fn, best), optx.RESULTS.nonlinear_divergence
    return End(y, [*losses, loss], verdict(reason))


def _descend_in_program(
    solver: Any, fn: Any, unknowns: Any, max_steps: int, patience: Any, gain: Any
) -> End:
    """The loop of `descend` over traced data."""
    arrays = lambda tree: jax.tree.map(jnp.asarray, tree)
    unknowns = arrays(unknowns)
    successful, going = optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached

    class State(NamedTuple):
        count: Any
        y: Any
        solver: Any
        losses: Any
        lowest: Any
        best: Any
        waited: Any
        has_ended: Any
        reason: Any

    def step(at: State) -> State:
        y, state, loss, done, result = _step(solver, fn, at.y, at.solver)
        waited = jnp.where(loss > (1 - gain) * at.lowest, at.waited + 1, 0)
        is_lower = loss < at.lowest
        ends = done | (waited >= patience) | (result != successful)
        return State(
            at.count + 1,
            y,
            state,
            at.losses.at[at.count].set(loss),
            jnp.where(is_lower, loss, at.lowest),
            jax.tree.map(functools.partial(jnp.where, is_lower), at.y, at.best),
            waited,
            ends,
            optx.RESULTS.where(ends, result, at.reason),
        )

    inf, zero = jnp.full((), jnp.inf, float), jnp.zeros((), int)
    first = State(
        zero,
        unknowns,
        _begin(solver, fn, unknowns),
        jnp.full(max_steps, jnp.nan, float),
        inf,
        unknowns,
        zero,
        jnp.zeros((), bool),
        arrays(going),
    )
    first = varying_as((fn, unknowns), first)
    at = while_loop(lambda at: ~at.has_ended & (at.count < max_steps), step, first)
    y, loss = _finish(solver, fn, at.y, at.solver, at.losses[at.count - 1], at.reason)
    diverged = ~jnp.isfinite(loss)
    y = jax.tree.map(functools.partial(jnp.where, diverged), at.best, y)
    loss = cond(diverged, lambda: _loss(fn, at.best), lambda: loss)
    reason = optx.RESULTS.where(diverged, optx.RESULTS.nonlinear_divergence, at.reason)
    return End(y, [at.losses, loss], verdict(reason))


class _Objective(eqx.Module):
    """The function that a solver evaluates: it returns a residual and its `Auxiliary`.

    `scalar`: for a minimiser, which takes the mean square as its value too.
    """

    residual: Any
    scalar: bool = eqx.field(static=True)

    def __call__(self, unknowns: Any, _: None) -> tuple[Array, Auxiliary]:
        residual, aux = _with_auxiliary(self.residual(unknowns))
        return (aux.loss if self.scalar else residual), aux

    def at(self, unknowns: Any, _: None) -> tuple[Array, Auxiliary]:
        """The same residual and loss as a call, without derivatives: by `residual.at`."""
        return _with_auxiliary(self.residual.at(unknowns))

    def stages(self, unknowns: Any, _: None) -> Stages | None:
        """The same residual and loss in two stages, where the residual has any."""
        stages = getattr(self.residual, "stages", lambda _: None)(unknowns)
        if stages is None:
            return None
        rest = lambda found, unknowns: _with_auxiliary(stages.rest(found, unknowns))
        return stages._replace(rest=rest)


def _with_auxiliary(found: Any) -> tuple[Array, Auxiliary]:
    """A residual and its `Auxiliary`, from what a residual function returned."""
    residual, details = found if isinstance(found, tuple) else (found, None)
    return residual, Auxiliary(jnp.mean(residual * residual), details)


def linear(residual: Callable[[Any], Any], unknowns: Any) -> Linear:
    """A residual, its Jacobian and its `Auxiliary`, by the program that `descend` runs."""
    return linearised(_Objective(residual, scalar=False), unknowns, None)


@functools.cache
def _default_solver(every: int = 1, radius: float = 1.0) -> LevenbergMarquardt:
    return LevenbergMarquardt(rtol=1e-4, atol=1e-5, every=every, radius=radius)


_REST = {"args": None, "options": {}, "tags": frozenset()}


def _is_ours(solver: Any) -> bool:
    """Whether a solver's state is all arrays, and its steps are compiled by themselves."""
    return isinstance(solver, LevenbergMarquardt)


def _initial_state(solver: Any, fn: _Objective, y: Any) -> Any:
    out, aux = eqx.filter_eval_shape(fn, y, None)
    return solver.init(fn, y, f_struct=out, aux_struct=aux, **_REST)


def _begin(solver, fn, y):
    """The state before the first step; of other solvers' states, the arrays."""
    state = _compiled_initial_state if _is_ours(solver) else _arrays_of_initial_state
    return state(solver, fn, y)


# Compiled so that the residual is traced for its shape once, not at every search.
_compiled_initial_state = eqx.filter_jit(_initial_state)


def _step(solver, fn, y, state):
    """Unknowns, state, the loss before the step, whether the search has ended, its verdict."""
    return (_stepped if _is_ours(solver) else _step_of_arrays)(solver, fn, y, state)


def _finish(solver, fn, y, state, loss, result):
    """The unknowns after the last step, and their loss."""
    if _is_ours(solver):
        y, aux, _ = solver.postprocess(fn, y, loss, state=state, result=result, **_REST)
        return y, aux.loss
    y = _end_of_arrays(solver, fn, y, state, loss, result)
    return y, _loss(fn, y)


def _stepped(solver, fn, y, state):
    y, state, aux = solver.step(fn, y, state=state, **_REST)
    return y, state, aux.loss, *solver.terminate(fn, y, state=state, **_REST)


@eqx.filter_jit
def _loss(fn, y):
    return fn(y, None)[1].loss


# The state of another solver holds functions, which `jit` compares by identity: passed to
# `jit` as it is, it would compile every search again. Only its arrays leave a compiled
# function, and go back into a state that is built inside the next one, so that all searches
# share one program.


def _arrays_of(state: Any) -> list[Any]:
    return jax.tree.leaves(eqx.filter(state, eqx.is_array))


def _state_with(solver: Any, fn: _Objective, y: Any, arrays: list[Any]) -> Any:
    """A solver's state that has these arrays."""
    initial, rest = eqx.partition(_initial_state(solver, fn, y), eqx.is_array)
    return eqx.combine(jax.tree.unflatten(jax.tree.structure(initial), arrays), rest)


@eqx.filter_jit
def _arrays_of_initial_state(solver, fn, y):
    return _arrays_of(_initial_state(solver, fn, y))


@eqx.filter_jit
def _step_of_arrays(solver, fn, y, arrays):
    y, state, *rest = _stepped(solver, fn, y, _state_with(solver, fn, y, arrays))
    return y, _arrays_of(state), *rest


@eqx.filter_jit
def _end_of_arrays(solver, fn, y, arrays, loss, result):
    state = _state_with(solver, fn, y, arrays)
    return solver.postprocess(fn, y, loss, state=state, result=result, **_REST)[0]
