"""Arguments: what becomes an array or a number, and what raises an error with the name."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, _checks


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


NUMBERS = np.array([[0.5, -2.0, 3.0]])


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8", ">f2", "<i2", ">i2", ">u4"])
def test_arrays_of_any_byte_order_keep_their_numbers_and_type(kind):
    given = (NUMBERS if "f" in kind else np.rint(np.abs(NUMBERS))).astype(kind)
    read = _checks.as_array("f(x)", given)
    assert isinstance(read, jax.Array)
    assert read.dtype == given.dtype.newbyteorder("=")
    np.testing.assert_array_equal(read, given)
    # A view with other strides, such as rows in reverse, is accepted.
    np.testing.assert_array_equal(_checks.as_array("f(x)", given[:, ::-1]), given[:, ::-1])


def test_arrays_of_other_kinds():
    for value in (NUMBERS.tolist(), tuple(map(tuple, NUMBERS)), np.longdouble(NUMBERS)):
        read = _checks.as_array("f(x)", value)
        assert read.dtype == jnp.float64
        np.testing.assert_array_equal(read, NUMBERS)
    assert _checks.as_array("f(x)", [True, False]).dtype == jnp.bool_
    assert _checks.as_array("f(x)", jnp.ones(2, jnp.bfloat16)).dtype == jnp.bfloat16
    traced = jax.jit(lambda x: _checks.as_array("f(x)", [x, 2.0]))(jnp.asarray(1.0))
    np.testing.assert_array_equal(traced, [1, 2])


def test_a_numpy_array_may_be_written_to_after_it_was_read():
    for size in (3, 64, 1000, 30_000):  # JAX may share memory that is aligned.
        for kind in ("float32", "float64", "int32"):
            given = [np.zeros(size, kind) for _ in range(8)]
            read = [_checks.as_array("f(x)", each) for each in given]
            for each in given:
                each[:] = 1
            np.testing.assert_array_equal(read, 0)


def test_as_numpy_keeps_what_jax_would_cut():
    for value in (np.array([2**40]), np.array([1e300]), np.array([0.5], ">f8")):
        found = _checks.as_numpy("f(x)", value)
        assert isinstance(found, np.ndarray)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, value)
    np.testing.assert_array_equal(_checks.as_numpy("f(x)", jnp.ones(2)), [1, 1])
    with pytest.raises(ValueError, match=r"`f\(x\)` must hold real numbers, got complex128"):
        _checks.as_numpy("f(x)", np.array([1j]))


@pytest.mark.parametrize(
    "value", [NUMBERS, NUMBERS.tolist(), jnp.full((2, 2), 4.0), np.arange(3), jnp.arange(3)]
)
def test_what_a_trace_closes_over_can_be_looked_at(value):
    seen = []

    @jax.jit
    def traced(x):
        seen.append(_checks.is_concrete(_checks.parameter("f(x)", value, None)))
        seen.append(_checks.is_concrete(_checks.as_array("f(x)", value)))
        return x

    traced(1.0)
    assert seen == [True, True]


class Unreadable:
    def __array__(self, *_, **__):
        raise RuntimeError("on another device")


NO_ARRAYS = {
    "None": (None, "must be an array, got None"),
    "str": ("a.png", "must be an array, got 'a.png'"),
    "bytes": (b"1", "must be an array, got b'1'"),
    "set": ({1.0}, r"must be an array, got \{1.0\}"),
    "dict": ({"R": NUMBERS, "G": NUMBERS}, r"one array, got a dict with the keys \['R', 'G'\]"),
    "object": (np.array([1.0, None]), "must hold real numbers, got a ndarray of object"),
    "strings": (np.array(["1.0"]), "must hold real numbers, got a ndarray of <U3"),
    "records": (np.zeros(2, [("z", "f4")]), "must hold real numbers, got a ndarray of"),
    "time": (np.datetime64("2026-01-01"), "must hold real numbers"),
    "list of None": ([None, 1.0], "must hold real numbers, got a list of object"),
    "ragged": ([[1.0], [1.0, 2.0]], "must be an array, got a list: "),
    "masked": (
        np.ma.masked_less(NUMBERS, 0),
        r"masked array. Fill .* `array.filled\(number\)`",
    ),
    "unmasked": (np.ma.masked_array(NUMBERS), "got a masked array"),
    "complex": (1j * NUMBERS, "must hold real numbers, got complex128"),
    "key": (jax.random.key(0), "must be a real number, got key"),
    "module": (np, "must be a real|must hold real"),
    "unreadable": (Unreadable(), "must be an array, got a Unreadable: on another device"),
}


@pytest.mark.parametrize("kind", NO_ARRAYS)
def test_what_is_no_array_is_named(kind):
    value, message = NO_ARRAYS[kind]
    for read in (_checks.as_array, lambda n, v: _checks.parameter(n, v, None)):
        with pytest.raises(ValueError, match=rf"^`f\(x\)` .*{message}|^`f\(x\)` {message}"):
            read("f(x)", value)


def test_integers_that_jax_would_cut():
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match=r"`f\(x\)` must hold numbers that int32 has, got"):
            _checks.as_array("f(x)", np.array([1, 2**40]))
        assert float(_checks.parameter("f(x)", np.array(2**40))) == 2.0**40
        assert float(_checks.parameter("f(x)", 2**40)) == 2.0**40


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (1, jnp.float64),
        (2.5, jnp.float64),
        (np.int32(3), jnp.float64),
        (np.uint16(3), jnp.float64),
        (np.float32(1), jnp.float32),
        (np.float16(1), jnp.float16),
        (np.array(1, ">f4"), jnp.float32),
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
        (
            [1.0, 2],
            r"`f\(x\)` must have shape \(\), got \(2,\). Batches are made with `jax.vmap`",
        ),
    ],
)
def test_errors_of_parameter(value, message):
    with pytest.raises(ValueError, match=message):
        _checks.parameter("f(x)", value)


def test_check_shape():
    _checks.check_shape("f(x)", np.ones((2, 3)), (2, 3))
    batch = r"`f\(x\)` must have shape \(3,\), got \(2, 3\). Batches are made with `jax.vmap`.$"
    with pytest.raises(ValueError, match=batch):
        _checks.check_shape("f(x)", np.ones((2, 3)), (3,))
    with pytest.raises(ValueError, match=r"`f\(x\)` must have shape \(3,\), got \(2,\).$"):
        _checks.check_shape("f(x)", np.ones(2), (3,))


def test_check():
    positive = lambda v: v > 0
    _checks.check("f(x)", jnp.array(1.0), positive, "positive")
    for value, shown in (
        (-3.0, "-3.0"),
        (np.nan, "nan"),
        (np.float32(-0.1), "-0.1"),
        ([1.0, -1], r"\[ 1. -1.\]"),
        (np.eye(5) + 1 - 2 * np.eye(5, k=2), r"-1.0 at \[0, 2\], one of 3 that are wrong"),
    ):
        with pytest.raises(ValueError, match=rf"`f\(x\)` must be positive, got {shown}\.$"):
            _checks.check("f(x)", jnp.array(value), positive, "positive")

    @jax.jit
    def traced(x):
        _checks.check("f(x)", x, positive, "positive")
        return x

    assert traced(-3.0) == -3


def test_share_and_shares():
    np.testing.assert_array_equal(_checks.share("f(x)", [True, False], (2,)), [1, 0])
    np.testing.assert_array_equal(_checks.share("f(x)", [0.5, np.nan], (2,)), [0.5, np.nan])
    assert _checks.share("f(x)", 1 + 1e-6, ()) == 1 + 1e-6  # a filter rounds
    for wrong in (255, -1, 1.1, np.inf):
        with pytest.raises(ValueError, match=r"`f\(x\)` must be in \[0, 1\], got"):
            _checks.share("f(x)", wrong, ())
    assert jax.jit(lambda x: _checks.share("f(x)", x, ()))(2.0) == 2
    assert _checks.shares("f(x)", None, 2, (3,)) == [None, None]
    none, half = _checks.shares("f(x)", (None, [0.5]), 2, (1,))
    assert none is None
    assert half == 0.5
    with pytest.raises(ValueError, match=r"`f\(x\)` must hold numbers or None for each of 3"):
        _checks.shares("f(x)", [None], 3, (1,))
    with pytest.raises(ValueError, match=r"`f\(x\)\[1\]` must be in \[0, 1\], got \[2.\]"):
        _checks.shares("f(x)", [None, [2.0]], 2, (1,))


def test_check_fields():
    class Lamp:
        SHAPES = {"color": (3,)}  # noqa: RUF012

        def __init__(self, color):
            self.color = color

    _checks.check_fields("f(lamp)", Lamp(np.ones(3)))
    with pytest.raises(
        ValueError, match=r"`f\(lamp\)` must be one Lamp, whose `color` .* `jax.vmap`"
    ):
        _checks.check_fields("f(lamp)", Lamp(np.ones((2, 3))))


def test_check_image():
    image = np.ones((2, 3, 1), np.float16)
    assert _checks.check_image("f(image)", image).dtype == jnp.float16
    for shape in ((2, 3), (1, 2, 3, 4), (0, 3, 1), (2, 0, 1), (2, 3, 0)):
        with pytest.raises(ValueError, match=r"`f\(image\)` must be an image of shape"):
            _checks.check_image("f(image)", np.ones(shape))
    with pytest.raises(ValueError, match=r"`f\(image\)` must hold floats .* got uint8"):
        _checks.check_image("f(image)", np.ones((2, 3, 1), np.uint8))


def test_check_depth_and_check_map():
    depth = np.array([[1.0, np.inf, 2, 0, -1, np.nan]])
    np.testing.assert_array_equal(_checks.check_depth("f(depth)", depth, (1, 6)), depth)
    with pytest.raises(ValueError, match=r"`f\(depth\)` must have .* \(3, 1\), got \(1, 6\)"):
        _checks.check_depth("f(depth)", depth, (3, 1))
    whole = _checks.check_depth("f(depth)", np.ones((1, 3), np.uint16), (1, 3))
    assert whole.dtype == jnp.float64
    traced = jax.jit(lambda d: _checks.check_depth("f(depth)", d, (1, 6)))
    np.testing.assert_array_equal(traced(-depth), -depth)
    np.testing.assert_array_equal(_checks.check_map("f(depth)", depth), depth)
    for shape in ((3,), (1, 2, 3), (0, 3)):
        with pytest.raises(ValueError, match=r"`f\(depth\)` must have shape \(height, width\)"):
            _checks.check_map("f(depth)", np.ones(shape))


def test_items():
    assert _checks.items("f(x)", (1, 2)) == [1, 2]
    assert [float(x) for x in _checks.items("f(x)", np.arange(2.0))] == [0, 1]
    for wrong in (None, "ab", {"a": 1}, {1}, 3, iter([1]), np.array(1.0)):
        with pytest.raises(
            ValueError, match=r"`f\(x\)` must be a sequence of at least one, got"
        ):
            _checks.items("f(x)", wrong)


def test_option():
    assert _checks.option("f(kind=...)", "tea", ("tea", "milk")) == "tea"
    for wrong in ("water", None, 1, ["tea"], np.array(["tea"])):
        with pytest.raises(
            ValueError, match=r"`f\(kind=...\)` must be one of \('tea', 'milk'\)"
        ):
            _checks.option("f(kind=...)", wrong, ("tea", "milk"))


WHOLE = [3, np.int64(3), np.uint8(3), np.array(3), jnp.asarray(3)]
BROKEN = [3.0, np.float32(3), np.float64(3), np.float16(3), jnp.asarray(3.0)]
NO_NUMBERS = [True, False, np.True_, jnp.asarray(True), None, "3", [3], np.array([3]), 3j]


@pytest.mark.parametrize("value", WHOLE + BROKEN, ids=repr)
def test_static_numbers(value):
    number = _checks.number("f(n=...)", value)
    assert type(number) is float
    assert number == 3
    if np.asarray(value).dtype.kind in "iu":
        whole = _checks.whole_number("f(n=...)", value)
        assert type(whole) is int
        assert whole == 3
    else:
        with pytest.raises(ValueError, match=r"`f\(n=...\)` must be a positive integer, got"):
            _checks.whole_number("f(n=...)", value)


@pytest.mark.parametrize("value", [*NO_NUMBERS, 0, -3, np.float32(-1), np.nan], ids=repr)
def test_what_is_no_static_number(value):
    with pytest.raises(ValueError, match=r"^`f\(n=...\)` must be positive, got "):
        _checks.number("f(n=...)", value)
    with pytest.raises(ValueError, match=r"^`f\(n=...\)` must be a positive integer, got "):
        _checks.whole_number("f(n=...)", value)


def test_static_numbers_are_not_traced():
    for read in (_checks.number, _checks.whole_number):
        with pytest.raises(ValueError, match=r"`f\(n=...\)` must be .* static, got a traced"):
            jax.jit(lambda n, read=read: read("f(n=...)", n))(3)


def test_a_module_of_scalars_shows_its_numbers():
    lens = ThinLens(0.1, 2.0, 100.0)
    text = _checks.with_numbers(lens)
    assert text == "ThinLens(aperture=0.1, focus_distance=2, focal_pixels=100)"
    no_scalar = jax.tree.map(lambda x: jnp.stack([x, x]), lens)
    assert "aperture=f" in _checks.with_numbers(no_scalar)


def test_every_helper_is_tested():
    tested = inspect.getsource(inspect.getmodule(test_every_helper_is_tested))
    for name, value in vars(_checks).items():
        if inspect.isroutine(value) and value.__module__ == _checks.__name__ and name[0] != "_":
            assert name in tested
