"""Nonlinear least squares by any solver of optimistix, one step at a time, every loss kept."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfx._progress import Bar


Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

# Our own solver has also converged when so many steps make the loss smaller by less than this
# share: in float32, rounding hides from it that it has arrived.
PATIENCE, GAIN = 6, 1e-5

# Where Huber's loss turns from squares to sizes, in standard deviations of the noise.
CORNER = 1.345

# An image has this many tiles a side whose residuals are taken for independent.
_TILES = 8


_Item: Any = type(optx.RESULTS.successful)


class Verdict(_Item):
    """One of `optimistix.RESULTS`, equal to it, that prints as a sentence, a success too."""

    def __repr__(self) -> str:
        return optx.RESULTS[self] or "The search converged."


def verdict(result: optx.RESULTS) -> Any:
    """A `Verdict` of optimistix' own."""
    (index,) = jax.tree.leaves(result)
    return Verdict(index, optx.RESULTS)


class End(NamedTuple):
    """Where a solver stopped, the losses at its start and after every step, its verdict."""

    unknowns: Any
    losses: list[Float[Array, ""]]
    result: optx.RESULTS

    def check(self, function: str, sought: str) -> None:
        """Raise `RuntimeError` where the solver failed."""
        if self.result != optx.RESULTS.successful:
            raise RuntimeError(
                f"`{function}` found no {sought} in {len(self.losses)} steps, the mean squared "
                f"residual going from {self.losses[0]:.3g} to {self.losses[-1]:.3g}: "
                f"{self.result} `throw=False` returns what was reached."
            )


def descend(
    residual: Callable[[Any], Float[Array, "..."]],
    unknowns: Any,
    *,
    solver: Solver | None,
    max_steps: int,
    bar: Bar,
    patience: int = PATIENCE,
    gain: float = GAIN,
) -> End:
    """From a start to the end that a solver finds, Levenberg-Marquardt if none is given.

    `residual` is an `equinox.Module`, from a pytree of numbers in JAX's default type to an
    array of that type: its class and shapes decide what is compiled anew. The loss is its mean
    square. Our own solver has also converged when `patience` steps make the loss smaller by
    less than `gain`, a share of it.
    """
    patience = patience if solver is None else max_steps
    solver = _default_solver() if solver is None else solver
    fn = _Objective(residual, isinstance(solver, optx.AbstractMinimiser))
    y, state = unknowns, _begin(solver, fn, unknowns)
    losses, lowest, best, waited = [], math.inf, y, 0
    reason = optx.RESULTS.nonlinear_max_steps_reached
    for _ in range(max_steps):
        given = y
        y, state, loss, done, result = _step(solver, fn, y, state)
        losses.append(loss)
        bar.step(mse=f"{float(loss):.3g}")
        waited = waited + 1 if loss > (1 - gain) * lowest else 0
        if loss < lowest:
            lowest, best = float(loss), given
        if done or waited >= patience or result != optx.RESULTS.successful:
            reason = result
            break
    y = _finish(solver, fn, y, state, losses[-1], reason)
    loss = _loss(fn, y)
    if not math.isfinite(loss):
        y, loss, reason = best, _loss(fn, best), optx.RESULTS.nonlinear_divergence
    return End(y, [*losses, loss], verdict(reason))


class _Objective(eqx.Module):
    """What a solver is given: the residual or, for a minimiser, its mean square; and that."""

    residual: Callable[[Any], Float[Array, "..."]]
    scalar: bool = eqx.field(static=True)

    def __call__(self, unknowns: Any, _: None) -> tuple[Array, Array]:
        residual = self.residual(unknowns)
        loss = jnp.mean(residual * residual)
        return (loss if self.scalar else residual), loss


@functools.cache
def _default_solver() -> optx.LevenbergMarquardt:
    return optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5)


# A solver's state holds functions, which `jit` compares by identity. Only its arrays leave a
# compiled function, and go back into a state made anew: so all searches share one program.
_REST = {"args": None, "options": {}, "tags": frozenset()}


def _new_state(solver: Any, fn: _Objective, y: Any) -> Any:
    out, loss = eqx.filter_eval_shape(fn, y, None)
    return solver.init(fn, y, f_struct=out, aux_struct=loss, **_REST)


def _arrays(state: Any) -> list[Any]:
    return jax.tree.leaves(eqx.filter(state, eqx.is_array))


def _state(solver: Any, fn: _Objective, y: Any, arrays: list[Any]) -> Any:
    old, static = eqx.partition(_new_state(solver, fn, y), eqx.is_array)
    return eqx.combine(jax.tree.unflatten(jax.tree.structure(old), arrays), static)


@eqx.filter_jit
def _begin(solver, fn, y):
    return _arrays(_new_state(solver, fn, y))


@eqx.filter_jit
def _step(solver, fn, y, arrays):
    # The loss is that of the `y` that was given.
    y, state, loss = solver.step(fn, y, state=_state(solver, fn, y, arrays), **_REST)
    return y, _arrays(state), loss, *solver.terminate(fn, y, state=state, **_REST)


@eqx.filter_jit
def _finish(solver, fn, y, arrays, loss, result):
    state = _state(solver, fn, y, arrays)
    return solver.postprocess(fn, y, loss, state=state, result=result, **_REST)[0]


@eqx.filter_jit
def _loss(fn, y):
    return fn(y, None)[1]


def huber(residual: Float[Array, "..."], corner: float = CORNER) -> Float[Array, "..."]:
    """Residuals whose squares are twice Huber's loss: they grow by the root beyond the corner.

    Source: Huber 1964, "Robust estimation of a location parameter", eq. 1.3.
    """
    size = jnp.abs(residual)
    beyond = size > corner
    root = jnp.sqrt(corner * (2 * jnp.where(beyond, size, corner) - corner))
    return jnp.where(beyond, jnp.sign(residual) * root, residual)


@functools.partial(jax.jit, static_argnames="count")
def covariance(
    columns: Float[Array, "residual unknown"],
    residual: Float[Array, " residual"],
    block: Int[Array, " residual"],
    count: int,
) -> Float[Array, "unknown unknown"]:
    """The covariance of what least squares find, by the jackknife over blocks of residuals.

    Each block is left out in turn, and the solution moves by one Gauss-Newton step. Residuals
    may depend on one another within a block; those of different blocks are taken for
    independent. A direction in which nothing moves has the variance of rounding's size.

    Source: Cameron & Miller 2015, "A practitioner's guide to cluster-robust inference", CV3.
    """
    norms = jnp.linalg.norm(columns, axis=0)
    is_told, unknowns = norms > 0, columns.shape[1]
    norms = jnp.where(is_told, norms, 1)
    scaled = columns / norms[None]
    sums = lambda values: jax.ops.segment_sum(values, block, count)
    curvature = jnp.stack([sums(scaled * scaled[:, [i]]) for i in range(unknowns)], axis=1)
    slope = sums(scaled * residual[:, None])
    floor = jnp.finfo(columns.dtype).eps
    rest = jnp.sum(curvature, axis=0, keepdims=True) - curvature
    eigenvalues, vectors = jnp.linalg.eigh(rest)
    along = jnp.einsum("bji,bj->bi", vectors, jnp.sum(slope, axis=0, keepdims=True) - slope)
    moves = jnp.einsum("bij,bj->bi", vectors, along / jnp.maximum(eigenvalues, floor))
    is_used = jnp.any(curvature != 0, axis=(1, 2))
    used = jnp.sum(is_used)
    is_enough = used > unknowns
    used = jnp.maximum(used, 1).astype(columns.dtype)
    moves = jnp.where(is_used[:, None], moves, 0)
    middle = jnp.sum(moves, axis=0, keepdims=True) / used
    moves = jnp.where(is_used[:, None], moves - middle, 0)
    found = (1 - 1 / used) * moves.T @ moves
    # Where leaving out a block changes nothing, since nothing moves at all.
    eigenvalues, vectors = jnp.linalg.eigh(jnp.sum(curvature, axis=0))
    flat = jnp.where(eigenvalues < 64 * floor, jnp.mean(residual**2) / floor, 0)
    found = (found + (vectors * flat[None]) @ vectors.T) / (norms[:, None] * norms[None])
    is_known = is_enough & is_told
    return jnp.where(is_known[:, None] & is_known[None], found, jnp.inf)


def tiles(shape: tuple[int, ...], side: int = _TILES) -> tuple[Int[Array, " residual"], int]:
    """For each residual of an image, in `side` x `side` tiles, its tile; and their number."""
    row, column = (jnp.arange(size) * side // size for size in shape[:2])
    tile = side * row[:, None] + column[None]
    return jnp.repeat(tile.reshape(-1), math.prod(shape[2:])), side * side


def standard_errors(
    columns: Float[Array, "residual unknown"], residual: Float[Array, "..."]
) -> Float[Array, " unknown"]:
    """Square roots of the diagonal of `sigma**2 (J^T J)^-1`; inf where J has a column of zeros.

    As if the residuals were independent and of one variance.
    """
    norms = jnp.linalg.norm(columns, axis=0)
    known = norms > 0
    scaled = columns / jnp.where(known, norms, 1)[None]
    eigenvalues, vectors = jnp.linalg.eigh(scaled.T @ scaled)
    floor = jnp.finfo(columns.dtype).eps
    variance = jnp.sum(vectors**2 / jnp.maximum(eigenvalues, floor)[None], axis=1)
    sigma = jnp.sqrt(jnp.sum(residual**2) / max(residual.size - columns.shape[1], 1))
    return jnp.where(known, sigma * jnp.sqrt(variance) / jnp.where(known, norms, 1), jnp.inf)
