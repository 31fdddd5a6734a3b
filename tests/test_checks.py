"""Arguments: what is read as an array or a number, and what is refused, by name."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import _checks


def test_is_concrete():
    seen = []

    @jax.jit
    def traced(x):
        seen.append(_checks.is_concrete(x))
        seen.append(_checks.is_concrete({"a": [1.0, x]}, 2))
        return x

    traced(1.0)
    assert seen == [False, False]
    assert _checks.is_concrete({"a": [1.0, jnp.ones(2)]}, None)


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
    array = _checks.parameter("f(x)", value)
    assert isinstance(array, jax.Array)
    assert array.dtype == dtype
    assert not array.weak_type
    assert float(array) == float(value)


def test_parameter_may_be_traced():
    traced = jax.jit(lambda x: _checks.parameter("f(x)", x, (2,)))
    np.testing.assert_array_equal(traced(jnp.ones(2)), [1, 1])
    assert jax.grad(lambda x: _checks.parameter("f(x)", x) ** 2)(3.0) == 6


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
        _checks.parameter("f(x)", value)


def test_check():
    positive = lambda v: v > 0
    _checks.check("f(x)", jnp.array(1.0), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got -3.0"):
        _checks.check("f(x)", jnp.array(-3.0), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got nan"):
        _checks.check("f(x)", jnp.array(np.nan), positive, "positive")
    with pytest.raises(ValueError, match=r"`f\(x\)` must be positive, got an array"):
        _checks.check("f(x)", jnp.array([1.0, -1]), positive, "positive")

    @jax.jit
    def traced(x):
        _checks.check("f(x)", x, positive, "positive")
        return x

    assert traced(-3.0) == -3


def test_check_image():
    image = np.ones((2, 3, 1), np.float16)
    assert _checks.check_image("f(image)", image).dtype == jnp.float16
    for shape in ((2, 3), (1, 2, 3, 4), (0, 3, 1), (2, 0, 1), (2, 3, 0)):
        with pytest.raises(ValueError, match=r"`f\(image\)` must be an image of shape"):
            _checks.check_image("f(image)", np.ones(shape))
    with pytest.raises(ValueError, match=r"`f\(image\)` must hold floats .* got uint8"):
        _checks.check_image("f(image)", np.ones((2, 3, 1), np.uint8))


def test_check_depth():
    depth = np.array([[1.0, np.inf, 2]])
    np.testing.assert_array_equal(_checks.check_depth("f(depth)", depth, (1, 3)), depth)
    with pytest.raises(ValueError, match=r"`f\(depth\)` must have .* \(3, 1\), got \(1, 3\)"):
        _checks.check_depth("f(depth)", depth, (3, 1))
    with pytest.raises(ValueError, match=r"`f\(depth\)` must hold floats .* got int64"):
        _checks.check_depth("f(depth)", np.ones((1, 3), int), (1, 3))
    for wrong in (0.0, -1.0, -np.inf, np.nan):
        message = r"`f\(depth\)` must be positive .* row 0, column 2; 1 pixels of 3 are wrong"
        with pytest.raises(ValueError, match=message):
            _checks.check_depth("f(depth)", np.array([[1.0, np.inf, wrong]]), (1, 3))
    traced = jax.jit(lambda d: _checks.check_depth("f(depth)", d, (1, 3)))
    np.testing.assert_array_equal(traced(-depth), -depth)


def test_every_helper_is_tested():
    tested = inspect.getsource(inspect.getmodule(test_every_helper_is_tested))
    for name, value in vars(_checks).items():
        if inspect.isroutine(value) and value.__module__ == _checks.__name__ and name[0] != "_":
            assert name in tested
