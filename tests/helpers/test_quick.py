import jax
import jax.numpy as jnp

from tests.helpers.quick import quickly


def test_quick_programs_are_kept_apart_from_others():
    traced = []

    @jax.jit
    def double(x):
        traced.append(jax.config.jax_disable_most_optimizations)
        return 2 * x

    for _ in range(2):
        double(jnp.ones(3))
        with quickly():
            double(jnp.ones(3))
    assert traced == [False, True]
