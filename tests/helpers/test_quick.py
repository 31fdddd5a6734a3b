import jax
import jax.numpy as jnp

from tests.helpers.quick import optimised, quickly


def test_quick_programs_are_kept_apart_from_others():
    traces = []

    @jax.jit
    def double(x):
        traces.append(jax.config.read("jax_disable_most_optimizations"))
        return 2 * x

    for _ in range(2):
        for context in (optimised, quickly):
            with context():
                double(jnp.ones(3))
    assert traces == [False, True]
