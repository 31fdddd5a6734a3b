"""The floor: finite gradients where the plain formula has none, and the checks of arguments."""

import inspect

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfx import _numerics


def slopes(function, *arguments):
    """Every derivative of a sum, in reverse and in forward mode."""
    total = lambda *xs: jnp.sum(function(*xs))
    xs = tuple(jnp.asarray(x, float) for x in arguments)
    numbers = tuple(range(len(xs)))
    return jax.jit(lambda *xs: [mode(total, numbers)(*xs) for mode in (jax.grad, jax.jacfwd)])(
        *xs
    )


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("safe_sqrt", ([0.1, 2, 9],)),
        ("safe_divide", ([1.0, -2], [3.0, -0.5])),
        ("normalize", ([[1.0, 2, -2], [0, 0.3, 0]],)),
        ("clip01", ([-0.5, 0.2, 0.9, 1.5],)),
        ("absolute", ([-2.0, 0.5],)),
        ("sum_planes", ([[0.3, -2.0], [1.0, 4.0]],)),
    ],
)
def test_values_and_gradients_at_smooth_points(name, arguments):
    plain = {
        "safe_sqrt": np.sqrt,
        "safe_divide": np.divide,
        "normalize": lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True),
        "clip01": lambda x: np.clip(x, 0, 1),
        "absolute": np.abs,
        "sum_planes": lambda planes: planes.sum(axis=0),
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


def test_is_concrete():
    seen = []

    @jax.jit
    def traced(x):
        seen.append(_numerics.is_concrete(x))
        seen.append(_numerics.is_concrete({"a": [1.0, x]}, 2))
        return x

    traced(1.0)
    assert seen == [False, False]
    assert _numerics.is_concrete({"a": [1.0, jnp.ones(2)]}, None)


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (1, jnp.float64),
        (2.5, jnp.float64),
        (np.int32(3), jnp.float64),
        (np.float32(1), jnp.float32),
        (np.float16(1), jnp.float16),
        (jnp.ones((), jnp.bfloat16), jnp.bfloat16),
    ],
)
def test_parameter(value, dtype):
    array = _numerics.parameter("f(x)", value)
    assert isinstance(array, jax.Array)
    assert array.dtype == dtype
    assert not array.weak_type
    assert float(array) == float(value)


def test_parameter_may_be_traced():
    traced = jax.jit(lambda x: _numerics.parameter("f(x)", x, (2,)))
    np.testing.assert_array_equal(traced(jnp.ones(2)), [1, 1])
    assert jax.grad(lambda x: _numerics.parameter("f(x)", x) ** 2)(3.0) == 6


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (True, r"`f\(x\)` must be a real number, got bool"),
        (1j, r"`f\(x\)` must be a real number, got complex128"),
        ([1.0, 2], r"`f\(x\)` must have shape \(\), got \(2,\)"),
    ],
)
def test_errors_of_parameter(value, message):
    with pytest.raises(ValueError, match=message):
        _numerics.parameter("f(x)", value)


def test_check():
    positive = lambda v: v > 0
    _numerics.check("f(x)", jnp.array(1.0), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got -3.0"):
        _numerics.check("f(x)", jnp.array(-3.0), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got nan"):
        _numerics.check("f(x)", jnp.array(np.nan), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got an array"):
        _numerics.check("f(x)", jnp.array([1.0, -1]), positive, "positive")

    @jax.jit
    def traced(x):
        _numerics.check("f(x)", x, positive, "positive")
        return x

    assert traced(-3.0) == -3


def test_check_image():
    image = np.ones((2, 3, 1), np.float16)
    assert _numerics.check_image("f(image)", image).dtype == jnp.float16
    for shape in ((2, 3), (1, 2, 3, 4), (0, 3, 1), (2, 0, 1), (2, 3, 0)):
        with pytest.raises(ValueError, match=r"`f\(image\)` must be an image of shape"):
            _numerics.check_image("f(image)", np.ones(shape))
    with pytest.raises(ValueError, match=r"`f\(image\)` must hold floats .* got uint8"):
        _numerics.check_image("f(image)", np.ones((2, 3, 1), np.uint8))


def test_check_depth():
    depth = np.array([[1.0, np.inf, 2]])
    np.testing.assert_array_equal(_numerics.check_depth("f(depth)", depth, (1, 3)), depth)
    with pytest.raises(ValueError, match=r"`f\(depth\)` must have .* \(3, 1\), got \(1, 3\)"):
        _numerics.check_depth("f(depth)", depth, (3, 1))
    with pytest.raises(ValueError, match=r"`f\(depth\)` must hold floats .* got int64"):
        _numerics.check_depth("f(depth)", np.ones((1, 3), int), (1, 3))
    for wrong in (0.0, -1.0, -np.inf, np.nan):
        message = r"`f\(depth\)` must be positive .* row 0, column 2; 1 pixels of 3 are wrong"
        with pytest.raises(ValueError, match=message):
            _numerics.check_depth("f(depth)", np.array([[1.0, np.inf, wrong]]), (1, 3))
    traced = jax.jit(lambda d: _numerics.check_depth("f(depth)", d, (1, 3)))
    np.testing.assert_array_equal(traced(-depth), -depth)


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


def test_every_helper_is_tested():
    tested = inspect.getsource(inspect.getmodule(test_every_helper_is_tested))
    for name, value in vars(_numerics).items():
        if (
            inspect.isroutine(value)
            and value.__module__ == _numerics.__name__
            and name[0] != "_"
        ):
            assert name in tested
