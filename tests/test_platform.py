"""Which program runs where, and how a batch is taken."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxfx._platform import by_platform, either, one_by_one_on_cpu
from tests.helpers.programs import for_accelerators


def _lowered(function, *operands, platform):
    return export.export(jax.jit(function), platforms=[platform])(*operands).mlir_module()


def test_a_program_is_chosen_when_it_is_lowered():
    chosen = lambda x: by_platform(x, cpu=jnp.sin, accelerator=jnp.cos)
    x = jnp.arange(3.0)
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

    x, pair = jnp.arange(6.0).reshape(3, 2), {"by": jnp.asarray(2.0), "to": jnp.ones(3)}
    axes = (0, {"by": None, "to": 0})
    mapped = jax.vmap(scaled, axes)
    scaled_x, to = mapped(x, pair)
    np.testing.assert_allclose(scaled_x, [[0, 1], [4, 6], [8, 10]])
    np.testing.assert_allclose(to, np.ones(3))
    twice = jax.vmap(mapped, (None, {"by": 0, "to": None}))
    stacked = twice(x, pair | {"by": jnp.asarray([2.0, 3.0])})[0]
    np.testing.assert_allclose(stacked[1], [[0, 1], [6, 9], [12, 15]])
    for platform in ("cpu", "cuda"):
        text = _lowered(mapped, x, pair, platform=platform)
        assert ("stablehlo.while" in text) == (platform == "cpu"), text


def test_two_programs_take_a_batch_each_in_its_way():
    both = one_by_one_on_cpu(jnp.sin, jnp.cos)
    x = jnp.arange(3.0)
    np.testing.assert_allclose(jax.jit(both)(x), np.sin(x))
    np.testing.assert_allclose(jax.jit(jax.vmap(both))(x), np.sin(x))
    for platform, name, other in (("cpu", "sine", "cosine"), ("cuda", "cosine", "sine")):
        for f in (both, jax.vmap(both), jax.vmap(jax.vmap(both, 0), None, axis_size=2)):
            text = _lowered(f, x, platform=platform)
            assert f"stablehlo.{name} " in text and f"stablehlo.{other} " not in text


def test_either_computes_one_of_two():
    is_small, small, large = lambda x, _: x.sum() < 3, lambda x, by: x, lambda x, by: by * x
    call = lambda x, by: either(is_small, small, large, x, by)
    x, by = jnp.asarray([[0.0, 1.0], [2.0, 3.0]]), jnp.asarray([5.0, 7.0])
    expected = np.array([[0, 1], [10, 15]])
    batch, nested = jax.vmap(call, (0, None)), jax.vmap(jax.vmap(call, (0, None)), (None, 0))
    for wrap in (contextlib.nullcontext, for_accelerators):
        with wrap():
            np.testing.assert_allclose(jax.jit(batch)(x, by[0]), expected)
            np.testing.assert_allclose(jax.jit(nested)(x, by)[1], [[0, 1], [14, 21]])
            np.testing.assert_allclose([call(each, by[0]) for each in x], expected)
    # A CPU looks at each member, an accelerator once at all of them.
    for platform in ("cpu", "cuda"):
        text = _lowered(batch, x, by[0], platform=platform)
        assert ("stablehlo.while" in text) == (platform == "cpu")
        assert "stablehlo.case" in text
