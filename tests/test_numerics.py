"""The floor: finite gradients where the plain formula has none."""

import functools
import inspect

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfx import _numerics
from tests.helpers.forms import first


def slopes(function, *arguments):
    """Every derivative of a sum, in reverse and in forward mode."""
    total = lambda *xs: jnp.sum(function(*xs))
    xs = tuple(jnp.asarray(x, float) for x in arguments)
    numbers = tuple(range(len(xs)))
    return jax.jit(lambda *xs: [mode(total, numbers)(*xs) for mode in (jax.grad, jax.jacfwd)])(
        *xs
    )


@first(
    ("name", "arguments"),
    [
        ("safe_sqrt", ([0.1, 2, 9],)),
        ("safe_divide", ([1.0, -2], [3.0, -0.5])),
        ("normalize", ([[1.0, 2, -2], [0, 0.3, 0]],)),
        ("clip01", ([-0.5, 0.2, 0.9, 1.5],)),
        ("absolute", ([-2.0, 0.5],)),
        ("inverse", ([[50.0, 2, 31], [1, 40, 24], [0.01, 0, 1]],)),
    ],
    3,
)
def test_values_and_gradients_at_smooth_points(name, arguments):
    plain = {
        "safe_sqrt": np.sqrt,
        "safe_divide": np.divide,
        "normalize": lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True),
        "clip01": lambda x: np.clip(x, 0, 1),
        "absolute": np.abs,
        "inverse": np.linalg.inv,
    }[name]
    function = getattr(_numerics, name)
    arguments = [np.array(argument) for argument in arguments]
    found = function(*map(jnp.asarray, arguments))
    np.testing.assert_allclose(found, plain(*arguments), rtol=1e-15)
    check_grads(jax.jit(function), arguments, order=2, rtol=1e-5, atol=1e-6, eps=1e-5)


@pytest.mark.parametrize(
    ("name", "arguments", "value"),
    [
        ("safe_sqrt", (0,), 0),
        ("safe_sqrt", (-4,), 0),
        ("safe_divide", (3, 0), 0),
        ("safe_divide", (0, 0), 0),
        ("normalize", ([0, 0, 0],), 0),
    ],
)
def test_degenerate_points_have_zero_derivatives(name, arguments, value):
    function = getattr(_numerics, name)
    np.testing.assert_array_equal(function(*(jnp.array(x, float) for x in arguments)), value)
    for mode in slopes(function, *arguments):
        for slope in mode:
            np.testing.assert_array_equal(slope, 0)
    # A second derivative too.
    twice = lambda *xs: jnp.sum(slopes(function, *xs)[0][0])
    for mode in slopes(twice, *arguments):
        assert all(np.all(np.isfinite(slope)) for slope in mode)


@pytest.mark.parametrize(
    ("name", "x", "slope"),
    [
        ("clip01", 0, 1),
        ("clip01", 1, 0),
        ("clip01", np.inf, 0),
        ("clip01", -np.inf, 0),
        ("absolute", 0, 1),
    ],
)
def test_kinks_take_the_derivative_from_above(name, x, slope):
    function = getattr(_numerics, name)
    for (found,) in slopes(function, x):
        assert found == slope
    if np.isfinite(x):
        step = 2.0**-20
        above = (function(jnp.array(x + step)) - function(jnp.array(float(x)))) / step
        assert above == slope


@hyp.given(st.integers(0, 2**32))
@hyp.settings(max_examples=30, deadline=None)
def test_normalize_gives_unit_vectors(seed):
    vector = np.random.default_rng(seed).normal(size=(4, 3))
    unit = _numerics.normalize(jnp.asarray(vector))
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1, rtol=1e-14)
    np.testing.assert_allclose(np.cross(unit, vector), 0, atol=1e-14)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((jnp.float16,), jnp.float32),
        ((jnp.bfloat16,), jnp.float32),
        ((jnp.float32,), jnp.float32),
        ((jnp.float64,), jnp.float64),
        ((jnp.float16, jnp.float64), jnp.float64),
        ((jnp.float16, jnp.bfloat16), jnp.float32),
    ],
)
def test_working_dtype(given, expected):
    """Where promotion is strict as well as where it is not."""
    for promotion in ("strict", "standard"):
        with jax.numpy_dtype_promotion(promotion):
            assert _numerics.working_dtype(*given) == expected
            assert _numerics.common_dtype(*given, jnp.float32) == expected
            assert _numerics.common_dtype(given[0]) == given[0]


def test_one_program_compiles_once_and_is_written_into_others():
    traces = []

    @functools.partial(_numerics.one_program, static_argnums=1)
    def powers(x, exponent):
        traces.append(exponent)
        return jnp.sin(x) ** exponent, {"sum": x + exponent}

    for _ in range(2):
        power, rest = powers(jnp.ones(3), 2)
    np.testing.assert_allclose(power, np.sin(1) ** 2, rtol=1e-15)
    np.testing.assert_array_equal(rest["sum"], 3)
    assert traces == [2]
    other = jax.jit(lambda x: powers(2 * x, 3)).lower(jnp.ones(3)).as_text()
    assert "stablehlo.sine" in other and "powers" not in other
    slope = jax.grad(lambda x: powers(x, 2)[0])(0.5)
    assert slope == pytest.approx(2 * np.sin(0.5) * np.cos(0.5), rel=1e-14)


def test_every_helper_is_tested():
    tested = inspect.getsource(inspect.getmodule(test_every_helper_is_tested))
    for name, value in vars(_numerics).items():
        if (
            inspect.isroutine(value)
            and value.__module__ == _numerics.__name__
            and name[0] != "_"
        ):
            assert name in tested
