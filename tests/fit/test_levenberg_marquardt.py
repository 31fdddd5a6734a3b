"""Our Levenberg-Marquardt against optimistix', step by step."""

import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxfx.fit._descent import _begin, _Objective, _step
from jaxfx.fit._levenberg_marquardt import LevenbergMarquardt
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
