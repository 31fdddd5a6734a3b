"""Our Levenberg-Marquardt against optimistix', step by step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from jaxfx._platform import of_directions
from jaxfx._progress import Bar
from jaxfx.fit import _levenberg_marquardt as levenberg_marquardt
from jaxfx.fit._descent import _begin, _Objective, _step, descend
from jaxfx.fit._levenberg_marquardt import LevenbergMarquardt, Stages, linearised
from tests.helpers.forms import first


def valley(y):
    """Rosenbrock's function: steps are rejected, and damped."""
    return jnp.stack([10 * (y["b"] - y["a"] ** 2), 1 - y["a"]])


def decay(y):
    """An exponential, whose residual has two axes."""
    time = jnp.linspace(0, 1, 30)
    seen = 2 * jnp.exp(-3 * time) + 0.5
    residual = y["b"] * jnp.exp(-y["a"] * time) + 0.5 - seen
    return residual.reshape(5, 6)


def underdetermined(y):
    """One equation for two unknowns."""
    return (y["a"] * y["b"] - 3.0)[None]


def broken(y):
    """Not finite from the start."""
    return jnp.log(jnp.stack([y["a"], y["b"]]) - 5.0)


def path(solver, function, steps):
    """Unknowns and loss of each step, whether the search has ended, and its verdict."""
    y = {"a": jnp.asarray(-1.2), "b": jnp.asarray(1.0)}
    objective = _Objective(function, scalar=False)
    state = _begin(solver, objective, y)
    for _ in range(steps):
        y, state, loss, done, result = _step(solver, objective, y, state)
        yield *map(float, (y["a"], y["b"], loss)), bool(done), result
        if done or result != optx.RESULTS.successful:
            return


@first(("function", "steps"), [(valley, 40), (decay, 20), (underdetermined, 20), (broken, 2)])
def test_every_step_is_that_of_optimistix(function, steps):
    ours, theirs = (
        make(rtol=1e-4, atol=1e-5) for make in (LevenbergMarquardt, optx.LevenbergMarquardt)
    )
    found, expected = list(path(ours, function, steps)), list(path(theirs, function, steps))
    assert len(found) == len(expected)
    for (*numbers, done, result), (*others, has_ended, verdict) in zip(
        found, expected, strict=True
    ):
        np.testing.assert_allclose(numbers, others, rtol=1e-9, atol=1e-12)
        assert done == has_ended
        assert (result == optx.RESULTS.successful) == (verdict == optx.RESULTS.successful)


class Line(eqx.Module):
    """A residual whose least mean square is in closed form: a line through points."""

    x: Array
    y: Array

    def __call__(self, unknowns):
        return unknowns["a"] + unknowns["b"] * self.x - self.y


@first(
    ("solver", "steps"),
    [
        (None, 40),
        (None, 3),
        (optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8), 40),
        (optx.BFGS(rtol=1e-8, atol=1e-8), 40),
    ],
)
def test_the_last_loss_is_the_mean_square_at_the_unknowns(solver, steps):
    x = np.linspace(-1, 2, 9)
    y = 0.5 + 2 * x + np.sin(9 * x)
    start = {"a": jnp.asarray(4.0), "b": jnp.asarray(-3.0)}

    def ended(x, y):
        with Bar(False, "fit") as bar:
            return descend(Line(x, y), start, solver=solver, max_steps=steps, bar=bar)

    for end in (ended(jnp.asarray(x), jnp.asarray(y)), jax.jit(ended)(x, y)):
        a, b = (float(end.unknowns[name]) for name in "ab")
        np.testing.assert_allclose(end.losses[-1], np.mean((a + b * x - y) ** 2), rtol=1e-12)
        if steps == 40:
            slope, intercept = np.polyfit(x, y, 1)
            np.testing.assert_allclose((a, b), (intercept, slope), rtol=1e-4)


def test_corrected_derivatives_lead_to_the_same_minimum(monkeypatch):
    linearisations, values = [], []
    linearised = levenberg_marquardt.linearised

    def counted(*data):
        linearisations.append(data)
        return linearised(*data)

    monkeypatch.setattr(levenberg_marquardt, "linearised", counted)
    start = {"a": jnp.asarray(1.0), "b": jnp.asarray(1.0)}

    class Decay(eqx.Module):
        def __call__(self, unknowns):
            return decay(unknowns)

        def at(self, unknowns):
            values.append(float(unknowns["a"]))
            return decay(unknowns)

    def ended(start):
        options = {"solver": None, "max_steps": 40, "every": 4}
        with Bar(False, "fit") as bar:
            return descend(Decay(), start, bar=bar, **options)

    end = ended(start)
    np.testing.assert_allclose([end.unknowns[name] for name in "ab"], (3, 2), rtol=1e-4)
    assert len(linearisations) == -(-(len(end.losses) - 1) // 4) < len(values)
    # The same steps where the search is one program.
    inside = jax.jit(ended)(start)
    np.testing.assert_allclose(
        inside.losses[0][: len(end.losses) - 1], end.losses[:-1], rtol=1e-6, atol=1e-20
    )


def test_steps_are_longer_where_a_large_residual_bends_the_loss_less():
    # Example 10.2.4 of Dennis & Schnabel 1983, "Numerical Methods for Unconstrained
    # Optimization and Nonlinear Equations": the minimum is at 0, where the loss bends by
    # 1 - 0.6 of what the Jacobian tells, so that each step leaves 0.6 of the way.
    def residual(y, _=None):
        return jnp.stack([y["a"] + 1, 0.6 * y["a"] ** 2 + y["a"] - 1]), jnp.zeros(())

    residual.at = residual

    def steps(every):
        solver = LevenbergMarquardt(rtol=1e-7, atol=1e-7, every=every, radius=1e4)
        y = {"a": jnp.asarray(0.5)}
        state = solver.init(residual, y, None, {}, jnp.zeros(2), jnp.zeros(()), frozenset())
        count = 0
        while not state.has_converged:
            y, state, _ = solver.step(residual, y, None, {}, state, frozenset())
            count += 1
        np.testing.assert_allclose(float(y["a"]), 0, atol=1e-6)
        return count

    assert steps(every=1) > 25
    assert steps(every=4) < 12


def test_a_step_that_is_not_finite_does_not_spoil_corrected_derivatives():
    # The logarithm of a negative number, whose derivative is finite and wrong, and a root's,
    # which is not finite. Steps from 9 are long enough.
    residual = lambda y, _: (jnp.stack([jnp.log(y["a"]), jnp.sqrt(y["a"]) - 1]), jnp.zeros(()))
    residual.at = residual
    solver = LevenbergMarquardt(rtol=1e-9, atol=1e-9, every=2)
    y = {"a": jnp.asarray(9.0)}
    state = solver.init(residual, y, None, {}, jnp.zeros(2), jnp.zeros(()), frozenset())
    tried = []
    for _ in range(40):
        tried.append(float(state.tried["a"]))
        y, state, _ = solver.step(residual, y, None, {}, state, frozenset())
    assert min(tried) < 0
    np.testing.assert_allclose(float(y["a"]), 1, rtol=1e-6)


class InStages:
    """A residual in two stages; `a` and `b` enter the first."""

    def __init__(self):
        self.directions = []

        @jax.custom_jvp
        def cubed(x):
            return x**3

        @cubed.defjvp
        def _(primals, tangents):
            (x,), (dot,) = primals, tangents
            return cubed(x), of_directions(self._tangents)(x, dot[None])[0]

        self.cubed = cubed

    def _tangents(self, x, dots):
        self.directions.append(len(dots))
        return 3 * x[None] ** 2 * dots

    def __call__(self, y, _):
        return self._rest(self._first(y), y)

    def stages(self, y, _):
        moving = {name: y[name] for name in ("a", "b")}
        return Stages(moving, self._first, self._rest)

    def _first(self, y):
        return self.cubed(jnp.outer(y["b"], jnp.arange(1.0, 4.0)) + y["a"])

    def _rest(self, found, y):
        residual = y["ahead"] * found + jnp.sin(y["a"] * y["past"])
        return residual, jnp.sum(residual)


def test_a_first_stage_is_differentiated_in_what_enters_it_alone():
    # `ahead` comes between the others where unknowns are in a row.
    y = {"a": 0.5, "ahead": 2.0, "b": [0.3, -0.7], "past": 1.5}
    y = {name: jnp.asarray(value) for name, value in y.items()}
    staged, rest = InStages(), {}
    found = linearised(staged, y, rest)
    assert set(staged.directions) <= {1, 3}

    def numbers(flat):
        a, ahead, b, past = flat[0], flat[1], flat[2:4], flat[4]
        cubed = (b[:, None] * np.arange(1.0, 4.0) + a) ** 3
        return (ahead * cubed + np.sin(a * past)).reshape(-1)

    at, step = np.asarray([0.5, 2.0, 0.3, -0.7, 1.5]), 1e-6
    np.testing.assert_allclose(found.residual, numbers(at), rtol=1e-12)
    np.testing.assert_allclose(found.aux, numbers(at).sum(), rtol=1e-12)
    slopes = [
        (numbers(at + step * axis) - numbers(at - step * axis)) / (2 * step)
        for axis in np.eye(5)
    ]
    np.testing.assert_allclose(found.jacobian, np.stack(slopes, axis=1), rtol=1e-7, atol=1e-8)


def test_a_larger_first_radius_saves_steps_where_residuals_are_small():
    x = np.linspace(-1, 2, 9)
    small = Line(jnp.asarray(0.01 * x), jnp.asarray(0.01 * (2 * x + 1)))

    def steps(radius):
        start = {"a": jnp.asarray(0.0), "b": jnp.asarray(0.0)}
        with Bar(False, "fit") as bar:
            options = {"solver": None, "max_steps": 40, "radius": radius}
            end = descend(small, start, bar=bar, **options)
        np.testing.assert_allclose(end.unknowns["b"], 2, rtol=1e-2)
        return len(end.losses)

    assert steps(1e4) < steps(1.0)
