"""Which program runs where, and how a batch is taken."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxfx._platform import by_platform, one_by_one_on_cpu


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
