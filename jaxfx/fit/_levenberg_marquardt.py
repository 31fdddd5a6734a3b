"""Levenberg-Marquardt by JAX's own linear algebra, which also goes inside `jax.shard_map`.

optimistix' own solver calls lineax, which compares the shardings of operator and vector: where
data vary over the devices of a mesh they differ, and it raises. Steps, damping and tests are
those of `optimistix.LevenbergMarquardt`, but for rounding.

Outside of any transform a step is two programs: `linearised`, which takes long to compile and
which a report of errors uses too, and what becomes of its numbers. Where derivatives cost much
more than a value, most steps take the value alone and correct the last derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxfx._checks import is_concrete
from jaxfx._loops import varying_as


# A step is accepted if the loss falls by this ratio of what the derivative promises, and the
# next one may be longer by a factor if it falls by the other; else it is shorter. From Gould,
# Orban, Sartenaer & Toint 2005, "Sensitivity of trust-region algorithms to their parameters".
_ACCEPTED, _GOOD, _LONGER, _SHORTER = 0.01, 0.99, 3.5, 0.25
# A step is made longer by at most this factor where the loss bends less than is expected.
_LONGEST = 3.0


_RESULTS: Any = optx.RESULTS


class _State(NamedTuple):
    """Residual and Jacobian at the last accepted unknowns, and the unknowns to evaluate next.

    - `tried`: the unknowns to evaluate next.
    - `residual`, `aux`: at the accepted unknowns.
    - `triangle`: R of the QR decomposition of the Jacobian with the residual as its last
      column: all that a step and its promise depend on.
    - `radius`: the inverse of the damping.
    - `age`: evaluations since that of the last derivatives.
    - `jacobian`: residual unknown; None where it is not corrected.
    """

    is_first: Bool[Array, ""]
    tried: Any
    residual: Float[Array, " residual"]
    triangle: Float[Array, "row column"]
    aux: Any
    radius: Float[Array, ""]
    has_converged: Bool[Array, ""]
    result: optx.RESULTS
    age: Int[Array, ""]
    jacobian: Any


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Damped Gauss-Newton steps, as long as the last ones were as good as promised.

    It has converged where an accepted step changes unknowns and residual by less than
    `atol + rtol * abs(value)`, each of them.

    Derivatives are computed once in `every` evaluations. The others correct the Jacobian by the
    last change of the residual; the function then has a method `at`, which gives the same as a
    call, in less time than derivatives take. Such a search makes steps longer where the loss
    bends less than the Jacobian tells.

    `radius` is that of the first step. The larger, the nearer it is to one of Gauss and Newton:
    near a minimum that saves the steps in which the radius grows.

    Source: Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters";
    Broyden 1965, "A class of methods for solving nonlinear simultaneous equations", for the
    correction, of which we take twice. Our own: the triangle that stands for Jacobian and
    residual, and longer steps.
    """

    rtol: float
    atol: float
    norm: Callable[[Any], Array] = optx.max_norm
    every: int = 1
    radius: float = 1.0

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step."""
        del fn, args, options, tags
        zeros = lambda struct: jnp.zeros(struct.shape, struct.dtype)
        unknowns, _ = ravel_pytree(y)
        columns, shape = unknowns.size + 1, (f_struct.size, unknowns.size)
        return _State(
            jnp.asarray(True),
            y,
            jnp.zeros(f_struct.size, f_struct.dtype),
            jnp.zeros((min(f_struct.size, columns), columns), unknowns.dtype),
            jax.tree.map(zeros, aux_struct),
            jnp.full((), self.radius, unknowns.dtype),
            jnp.asarray(False),
            optx.RESULTS.successful,
            jnp.zeros((), jnp.int32),
            jnp.zeros(shape, f_struct.dtype) if self.corrects else None,
        )

    def step(self, fn: Any, y, args, options, state: _State, tags) -> tuple[Any, _State, Any]:
        """Evaluate the unknowns that are tried, accept them or not, and choose the next."""
        del options, tags
        is_due = state.age == 0
        if self.corrects and is_concrete(state) and not is_due:
            linear = _corrected(y, state, *fn.at(state.tried, args))
        else:
            linear = linearised(fn, state.tried, args)
            if self.corrects and not is_concrete(state):
                # The same search where all of it is one program: which way a step goes depends
                # on data, so that both would be compiled.
                corrected = _corrected(y, state, linear.residual, linear.aux)
                linear = jax.tree.map(lambda *x: jnp.where(is_due, *x), linear, corrected)
        return _after(self, y, state, linear)

    @property
    def corrects(self) -> bool:
        """Whether there are evaluations without derivatives."""
        return self.every > 1

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the search has ended, and its verdict."""
        return state.has_converged, state.result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """The unknowns as they are, and the auxiliary output at them."""
        return y, state.aux, {}


class Linear(NamedTuple):
    """A residual, its Jacobian and the auxiliary output of its function, at some unknowns.

    Unknowns are in the order of `ravel_pytree`, residuals in that of the function's array.
    """

    residual: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
    aux: Any


class Stages(NamedTuple):
    """A function whose value costs most in a first stage, which some unknowns don't enter.

    - `moving`: the entries of the unknowns, a dict, that enter it.
    - `first(moving)`: its result, one array.
    - `rest(found, unknowns)`: the function of that result and of all unknowns.
    """

    moving: dict[str, Any]
    first: Callable[[Any], Array]
    rest: Callable[[Array, Any], Any]


@eqx.filter_jit
def linearised(fn: Callable[[Any, Any], tuple[Array, Any]], y: Any, args: Any) -> Linear:
    """A function that returns a residual and an auxiliary output, linearised at `y`.

    If it has a method `stages(y, args)` that gives `Stages`, no derivative of the first stage
    is computed in an unknown that does not enter it. For other functions that gives None.
    """
    flat, unravel = ravel_pytree(y)
    basis = varying_as(flat, jnp.eye(flat.size, dtype=flat.dtype))
    stages: Stages | None = getattr(fn, "stages", lambda *_: None)(y, args)
    if stages is None:

        def of_flat(flat):
            residual, aux = fn(unravel(flat), args)
            return residual.reshape(-1), aux

        residual, push, aux = jax.linearize(of_flat, flat, has_aux=True)
        return Linear(residual, jax.vmap(push, out_axes=1)(basis), aux)

    def of_both(found, flat):
        residual, aux = stages.rest(found, unravel(flat))
        return residual.reshape(-1), aux

    moving, unravel_moving = ravel_pytree(stages.moving)
    found, push_first = jax.linearize(lambda flat: stages.first(unravel_moving(flat)), moving)
    residual, push_rest, aux = jax.linearize(of_both, found, flat, has_aux=True)
    # In the order of `ravel_pytree`.
    enters = np.concatenate([[name in stages.moving] * y[name].size for name in sorted(y)])
    dots = jax.vmap(push_first)(basis[enters][:, enters])
    found_dots = jnp.zeros((flat.size, *found.shape), found.dtype).at[enters].set(dots)
    return Linear(residual, jax.vmap(push_rest, out_axes=1)(found_dots, basis), aux)


@eqx.filter_jit
def _corrected(y: Any, state: _State, residual: Array, aux: Any) -> Linear:
    """The residual at `state.tried` with a Jacobian that is corrected, not computed.

    Broyden's correction is the least change of the Jacobian after which the step from `y`
    to `state.tried` changes the residual by as much as was evaluated: the mean Jacobian of the
    step. Twice that is the Jacobian at its end, of a residual that is quadratic along it.
    Large residuals need it, since the slope of the loss is their product with the Jacobian. A
    step of length 0, or to a residual that is not finite, corrects nothing.
    """
    moved = ravel_pytree(state.tried)[0] - ravel_pytree(y)[0]
    residual = residual.reshape(-1)
    missed = residual - state.residual - state.jacobian @ moved
    square = jnp.sum(moved * moved)
    is_told = (square > 0) & jnp.all(jnp.isfinite(missed))
    per_missed = jnp.where(is_told, moved / jnp.where(square > 0, square, 1), 0)
    correction = jnp.where(is_told, missed, 0)[:, None] * per_missed[None]
    return Linear(residual, state.jacobian + 2 * correction, aux)


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
    residual = chosen(residual, state.residual)
    if solver.corrects:
        # A step that is not accepted tells how the residual changes too, where it is finite.
        is_told = jnp.all(jnp.isfinite(jnp.append(linear.residual, jacobian)))
        jacobian = jnp.where(is_told, jacobian, state.jacobian)
        triangle = _triangle(jnp.concatenate([jacobian, residual[:, None]], axis=1))
    else:
        triangle = chosen(triangle, state.triangle)
    here = chosen(tried, here)
    step = _damped(triangle, radius)
    if solver.corrects:
        longer = _lengthened(step, moved, state, residual, jacobian)
        step = jnp.where(accepted & ~state.is_first, longer, step)
    is_finite = jnp.all(jnp.isfinite(step))
    result = _RESULTS.where(is_finite, _RESULTS.successful, _RESULTS.singular)
    after = _State(
        jnp.asarray(False),
        unravel(here - step),
        residual,
        triangle,
        chosen(aux, state.aux),
        radius,
        has_converged,
        result,
        (state.age + 1) % solver.every,
        jacobian if solver.corrects else None,
    )
    # What is reported belongs to the unknowns before the step.
    before = jax.tree.map(lambda *x: jnp.where(state.is_first, *x), aux, state.aux)
    return unravel(here), after, before


def _lengthened(
    step: Float[Array, " unknown"],
    moved: Float[Array, " unknown"],
    before: _State,
    residual: Float[Array, " residual"],
    jacobian: Float[Array, "residual unknown"],
) -> Float[Array, " unknown"]:
    """The next step, longer where it goes on as the last one did and the loss bends less.

    Where residuals are large at the minimum, the loss may bend much less than the Jacobian
    tells, and each step goes the same part of what is left. The change of the residual by the
    last step, `moved`, tells how much it bends along that step. The part of the next step
    along it is multiplied by the ratio of both curvatures, at most by `_LONGEST`.

    `residual` and `jacobian` are those at the end of the last step, `before` is the state at
    its beginning. A step is subtracted from the unknowns.
    """
    changed = residual - before.residual
    expected = jnp.sum(changed * changed)
    bend = expected + 2 * jnp.sum((changed - before.jacobian @ moved) * before.residual)
    is_bent = bend * _LONGEST > expected
    ratio = jnp.where(is_bent, expected / jnp.where(is_bent, bend, 1), _LONGEST)
    along = jnp.sum(changed * (jacobian @ step)) / jnp.where(expected > 0, expected, 1)
    goes_on = (expected > 0) & (along < 0) & (ratio > 1)
    return step + jnp.where(goes_on, (ratio - 1) * along, 0) * moved


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
