"""Levenberg-Marquardt by JAX's own linear algebra, which also goes inside `jax.shard_map`.

optimistix' own solver calls lineax, which compares the shardings of operator and vector: where
data vary over the devices of a mesh they differ, and it raises. Steps, damping and tests are
those of `optimistix.LevenbergMarquardt`, but for rounding.

Outside of any transform a step is two programs: `linearised`, which takes long to compile and
which a report of errors uses too, and what becomes of its numbers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from jaxfx._loops import varying_as


# A step is accepted if the loss falls by this ratio of what the derivative promises, and the
# next one may be longer by a factor if it falls by the other; else it is shorter. From Gould,
# Orban, Sartenaer & Toint 2005, "Sensitivity of trust-region algorithms to their parameters".
_ACCEPTED, _GOOD, _LONGER, _SHORTER = 0.01, 0.99, 3.5, 0.25


_RESULTS: Any = optx.RESULTS


class _State(NamedTuple):
    """Residual and Jacobian at the last accepted unknowns, and the unknowns to evaluate next.

    - `tried`: the unknowns to evaluate next.
    - `residual`, `aux`: at the accepted unknowns.
    - `triangle`: R of the QR decomposition of the Jacobian with the residual as its last
      column: all that a step and its promise depend on.
    - `radius`: the inverse of the damping.
    """

    is_first: Bool[Array, ""]
    tried: Any
    residual: Float[Array, " residual"]
    triangle: Float[Array, "row column"]
    aux: Any
    radius: Float[Array, ""]
    has_converged: Bool[Array, ""]
    result: optx.RESULTS


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Damped Gauss-Newton steps, as long as the last ones were as good as promised.

    It has converged where an accepted step changes unknowns and residual by less than
    `atol + rtol * abs(value)`, each of them.

    Source: Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters".
    Our own: the triangle that stands for Jacobian and residual.
    """

    rtol: float
    atol: float
    norm: Callable[[Any], Array] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step."""
        del fn, args, options, tags
        zeros = lambda struct: jnp.zeros(struct.shape, struct.dtype)
        unknowns, _ = ravel_pytree(y)
        columns = unknowns.size + 1
        return _State(
            jnp.asarray(True),
            y,
            jnp.zeros(f_struct.size, f_struct.dtype),
            jnp.zeros((min(f_struct.size, columns), columns), unknowns.dtype),
            jax.tree.map(zeros, aux_struct),
            jnp.ones((), unknowns.dtype),
            jnp.asarray(False),
            optx.RESULTS.successful,
        )

    def step(self, fn, y, args, options, state: _State, tags) -> tuple[Any, _State, Any]:
        """Evaluate the unknowns that are tried, accept them or not, and choose the next."""
        del options, tags
        return _after(self, y, state, linearised(fn, state.tried, args))

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the search has ended, and its verdict."""
        return state.has_converged, state.result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """The unknowns as they are, and what came beside their residual."""
        return y, state.aux, {}


class Linear(NamedTuple):
    """A residual, its Jacobian and what comes beside it, at some unknowns.

    Unknowns are in the order of `ravel_pytree`, residuals in that of the function's array.
    """

    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    aux: Any


@eqx.filter_jit
def linearised(fn: Callable[[Any, Any], tuple[Array, Any]], y: Any, args: Any) -> Linear:
    """A function that gives a residual and something beside it, linearised at `y`."""
    flat, unravel = ravel_pytree(y)

    def of_flat(flat):
        residual, aux = fn(unravel(flat), args)
        return residual.reshape(-1), aux

    residual, push, aux = jax.linearize(of_flat, flat, has_aux=True)
    basis = jnp.eye(flat.size, dtype=flat.dtype)
    return Linear(residual, jax.vmap(push, out_axes=1)(varying_as(flat, basis)), aux)


@eqx.filter_jit
def _after(
    solver: LevenbergMarquardt, y: Any, state: _State, linear: Linear
) -> tuple[Any, _State, Any]:
    """Unknowns, state and reported loss after a step to `state.tried`, linearised there."""
    here, _ = ravel_pytree(y)
    tried, unravel = ravel_pytree(state.tried)
    residual, jacobian, aux = linear
    triangle = _triangle(jnp.concatenate([jacobian, residual[:, None]], axis=1))

    moved = tried - here
    promised = (
        jnp.sum((state.triangle @ jnp.append(moved, 1)) ** 2)
        - jnp.sum(state.triangle[:, -1] ** 2)
    ) / 2
    change = (jnp.sum(residual**2) - jnp.sum(state.residual**2)) / 2
    is_good = ~state.is_first & (promised < 0) & (change < _GOOD * promised)
    accepted = state.is_first | (change <= _ACCEPTED * promised)
    factor = jnp.where(accepted, jnp.where(is_good, _LONGER, 1.0), _SHORTER)
    radius = state.radius * factor.astype(state.radius.dtype)
    is_small = lambda change, value: jnp.all(
        jnp.abs(change) < solver.atol + solver.rtol * jnp.abs(value)
    )
    has_converged = (
        accepted & is_small(moved, tried) & is_small(residual - state.residual, residual)
    )
    chosen = lambda new, old: jax.tree.map(
        lambda new, old: jnp.where(accepted, new, old), new, old
    )
    triangle = chosen(triangle, state.triangle)
    here = chosen(tried, here)
    step = _damped(triangle, radius)
    is_finite = jnp.all(jnp.isfinite(step))
    result = _RESULTS.where(is_finite, _RESULTS.successful, _RESULTS.singular)
    after = _State(
        jnp.asarray(False),
        unravel(here - step),
        chosen(residual, state.residual),
        triangle,
        chosen(aux, state.aux),
        radius,
        has_converged,
        result,
    )
    # What is reported belongs to the unknowns before the step.
    before = jax.tree.map(lambda *x: jnp.where(state.is_first, *x), aux, state.aux)
    return unravel(here), after, before


def _triangle(matrix: Float[Array, "row column"]) -> Float[Array, "few column"]:
    """R of the matrix' QR decomposition."""
    return jnp.linalg.qr(matrix, mode="r")


def _damped(triangle: Float[Array, "row column"], radius: Float[Array, ""]) -> Array:
    """The unknowns x of least |J x - r|^2 + |x|^2 / radius, by the triangle of (J, r)."""
    kind = jnp.finfo(triangle.dtype)
    is_long = radius > kind.eps
    damping = jnp.where(is_long, 1 / jnp.where(is_long, radius, 1), kind.max)
    count = triangle.shape[1] - 1
    below = jnp.sqrt(damping) * jnp.eye(count, count + 1, dtype=triangle.dtype)
    square = _triangle(jnp.concatenate([triangle, below]))[:count]
    return jax.scipy.linalg.solve_triangular(square[:, :count], square[:, count])
