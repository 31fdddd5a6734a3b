import jax
import jax.numpy as jnp

from tests.helpers.quick import optimised, quickly


def test_quick_programs_are_kept_apart_from_others():
    traces = []

    @jax.jit
    def double(x):
        traces.append(is_quick)
        return 2 * x

    for _ in range(2):
        for is_quick, context in ((False, optimised), (True, quickly)):
            with context():
                double(jnp.ones(3))
    assert traces == [False, True]
