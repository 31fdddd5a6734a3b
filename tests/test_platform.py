"""Which program runs where, and how a batch is taken."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxfx._platform import (
    by_platform,
    either,
    in_groups,
    of_directions,
    one_by_one,
    one_by_one_on_cpu,
)
from tests.helpers.quick import for_accelerators


# Programs for every platform, as users have them.
pytestmark = pytest.mark.usefixtures("optimised")


def _lowered(function, *operands, platform):
    return export.export(jax.jit(function), platforms=[platform])(*operands).mlir_module()


def test_a_program_is_chosen_when_it_is_lowered():
    chosen = lambda x: by_platform(x, cpu=jnp.sin, accelerator=jnp.cos)
    x = np.arange(3.0)
    for f, expected in ((chosen, np.sin), (jax.grad(lambda x: chosen(x).sum()), np.cos)):
        np.testing.assert_allclose(jax.jit(f)(x), expected(x))
    for platform, name, other in (("cpu", "sine", "cosine"), ("cuda", "cosine", "sine")):
        for f in (chosen, jax.vmap(chosen)):
            text = _lowered(f, x, platform=platform)
            assert f"stablehlo.{name} " in text and f"stablehlo.{other} " not in text


def test_a_batch_goes_one_by_one_on_a_cpu_and_at_once_elsewhere():
    @one_by_one_on_cpu
    def scaled(x, pair):
        return jax.lax.cond(x.sum() > 3, lambda: x * pair["by"], lambda: x), pair["to"]

    x, pair = np.arange(6.0).reshape(3, 2), {"by": np.array(2.0), "to": np.ones(3)}
    axes = (0, {"by": None, "to": 0})
    mapped = jax.vmap(scaled, axes)
    scaled_x, to = mapped(x, pair)
    np.testing.assert_allclose(scaled_x, [[0, 1], [4, 6], [8, 10]])
    np.testing.assert_allclose(to, np.ones(3))
    twice = jax.vmap(mapped, (None, {"by": 0, "to": None}))
    stacked = np.asarray(twice(x, pair | {"by": np.array([2.0, 3.0])})[0])
    np.testing.assert_allclose(stacked[1], [[0, 1], [6, 9], [12, 15]])
    for platform in ("cpu", "cuda"):
        text = _lowered(mapped, x, pair, platform=platform)
        assert ("stablehlo.while" in text) == (platform == "cpu"), text


def test_two_programs_take_a_batch_each_in_its_way():
    both = one_by_one_on_cpu(jnp.sin, jnp.cos)
    x = np.arange(3.0)
    np.testing.assert_allclose(jax.jit(both)(x), np.sin(x))
    np.testing.assert_allclose(jax.jit(jax.vmap(both))(x), np.sin(x))
    for platform, name, other in (("cpu", "sine", "cosine"), ("cuda", "cosine", "sine")):
        for f in (both, jax.vmap(both), jax.vmap(jax.vmap(both, 0), None, axis_size=2)):
            text = _lowered(f, x, platform=platform)
            assert f"stablehlo.{name} " in text and f"stablehlo.{other} " not in text


def test_either_computes_one_of_two():
    is_small, small, large = lambda x, _: x.sum() < 3, lambda x, by: x, lambda x, by: by * x
    call = lambda x, by: either(is_small, small, large, x, by)
    x, by = np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([5.0, 7.0])
    expected = np.array([[0, 1], [10, 15]])
    batch, nested = jax.vmap(call, (0, None)), jax.vmap(jax.vmap(call, (0, None)), (None, 0))
    for wrap in (contextlib.nullcontext, for_accelerators):
        with wrap():
            np.testing.assert_allclose(jax.jit(batch)(x, by[0]), expected)
            of_each = np.asarray(jax.jit(nested)(x, by))
            np.testing.assert_allclose(of_each[1], [[0, 1], [14, 21]])
            np.testing.assert_allclose([call(each, by[0]) for each in x], expected)
    # A CPU looks at each member, an accelerator once at all of them.
    for platform in ("cpu", "cuda"):
        text = _lowered(batch, x, by[0], platform=platform)
        assert ("stablehlo.while" in text) == (platform == "cpu")
        assert "stablehlo.case" in text


def _counted(calls):
    """`tangents(point, dots)` of `point["a"] ** 2 * point["b"]`, which notes each trace."""

    def tangents(point, dots):
        calls.append(len(dots["a"]))
        a, b = point["a"][None], point["b"][None]
        return 2 * a * b * dots["a"] + a * a * dots["b"]

    return tangents


def test_directions_at_one_point_are_one_call_whatever_the_order_of_the_batches():
    rng = np.random.default_rng(0)
    points = {name: rng.normal(size=(2, 3)) for name in "ab"}
    dots = {name: rng.normal(size=(5, 2, 3)) for name in "ab"}
    numbers = lambda *trees: [x for tree in trees for x in tree.values()]
    product = lambda a, b, a_dot, b_dot: 2 * a * b * a_dot + a**2 * b_dot
    expected = product(*numbers(points, dots))
    calls = []

    def along(point, dot):
        return of_directions(_counted(calls))(point, jax.tree.map(lambda x: x[None], dot))[0]

    of_points = jax.vmap(along)
    outside = jax.vmap(of_points, (None, 0))
    inside = jax.vmap(jax.vmap(along, (None, 0)), (0, 1), 1)
    for function in (outside, inside, jax.jit(outside)):
        calls.clear()
        np.testing.assert_allclose(function(points, dots), expected, rtol=1e-12)
        assert calls[-1] == 5
    first = jax.tree.map(lambda x: x[0], points)
    # Of a direction, that of one leaf alone may be in the batch; and batches of batches.
    mixed = {"a": dots["a"][:, 0], "b": dots["b"][0, 0]}
    found = jax.jit(jax.vmap(along, (None, {"a": 0, "b": None})))(first, mixed)
    np.testing.assert_allclose(found, product(*numbers(first, mixed)), rtol=1e-12)
    of_all = jax.jit(jax.vmap(jax.vmap(along, (None, 0)), (None, 1), 1))
    found = of_all(first, dots)
    np.testing.assert_allclose(found, product(*numbers(first, dots)), rtol=1e-12)
    assert calls[-1] == 10


def test_many_directions_are_computed_in_groups():
    rng = np.random.default_rng(0)
    point = {name: rng.normal(size=3) for name in "ab"}
    for count in (1, 4, 5, 9):
        dots = {name: rng.normal(size=(count, 3)) for name in "ab"}
        calls = []
        tangents = _counted(calls)
        whole = tangents(point, dots)
        calls.clear()
        grouped = in_groups(lambda static, *data, f=tangents: static * f(*data), 4)
        found = jax.jit(grouped, static_argnums=0)(2, point, dots)
        np.testing.assert_allclose(found, 2 * whole, rtol=1e-12)
        assert max(calls) == {1: 1, 4: 4, 5: 3, 9: 3}[count]
        one = lambda _, point, dot: jax.jvp(lambda p: p["a"] ** 2 * p["b"], (point,), (dot,))[1]
        found = jax.jit(one_by_one(one))(0, point, dots)
        np.testing.assert_allclose(found, whole, rtol=1e-12)
