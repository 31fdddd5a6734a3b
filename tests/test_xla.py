"""The workarounds for XLA compute what the plain forms compute, derivatives included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfx._xla
from benchmarks.xla import reproducers


@pytest.mark.parametrize("name", ["apart", "stored", "added_in_groups", "sum_planes"])
def test_a_workaround_has_the_values_and_derivatives_of_the_plain_form(name):
    array, plain, ours = reproducers()[name]
    np.testing.assert_allclose(jax.jit(ours)(array), jax.jit(plain)(array), rtol=1e-5)
    slope = lambda f: jax.jit(jax.grad(lambda x: jnp.sum(jnp.sin(f(x)))))
    np.testing.assert_allclose(slope(ours)(array), slope(plain)(array), atol=1e-3)


def test_every_workaround_has_a_reproducer():
    public = {name for name in vars(jaxfx._xla) if not name.startswith("_")}
    own = {
        name
        for name in public
        if getattr(vars(jaxfx._xla)[name], "__module__", "") == "jaxfx._xla"
    }
    assert own - {"added"} == set(reproducers())


def test_a_stored_value_that_is_not_needed_is_zero():
    double = lambda x: {"twice": 2 * x}
    program = jax.jit(lambda is_needed, x: jaxfx._xla.stored(is_needed, double, x))
    for is_needed in (True, False):
        out = program(is_needed, np.arange(3.0))
        np.testing.assert_array_equal(out["twice"], is_needed * 2 * np.arange(3.0))


@pytest.mark.parametrize("first", [np.nan, np.inf, -np.inf])
def test_what_is_kept_apart_does_not_depend_on_the_number_that_is_looked_at(first):
    array = np.array([first, 1.0, 2.0])
    program = jax.jit(lambda x: jaxfx._xla.apart(x, lambda: {"twice": 2 * x}))
    np.testing.assert_array_equal(program(array)["twice"], 2 * array)


@pytest.mark.parametrize("axis", [0, 1, -1])
def test_planes_are_summed_over_any_axis(axis):
    planes = np.random.default_rng(0).random((3, 4, 5))
    total = jax.jit(lambda planes: jaxfx._xla.sum_planes(planes, axis))(planes)
    np.testing.assert_allclose(total, planes.sum(axis=axis), rtol=1e-15)
