import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx._platform import by_platform
from tests.helpers.quick import for_accelerators, optimised, quickly


# The contexts, one in the other; whether little is optimised; the programs that are traced.
KINDS = [
    ((optimised,), False, {"cpu", "accelerator"}),
    ((quickly,), True, {"cpu"}),
    ((quickly, for_accelerators), True, {"accelerator"}),
    ((for_accelerators, optimised), False, {"accelerator"}),
]


def test_programs_of_each_kind_are_kept_apart():
    settings, traced = [], []

    def program(name, factor):
        return lambda x: traced.append(name) or factor * x

    @jax.jit
    def chosen(x):
        settings.append(jax.config.read("jax_disable_most_optimizations"))
        return by_platform(x, cpu=program("cpu", 2), accelerator=program("accelerator", 3))

    for is_first in (True, False):
        for contexts, is_quick, programs in KINDS:
            settings.clear(), traced.clear()
            with contextlib.ExitStack() as stack:
                for context in contexts:
                    stack.enter_context(context())
                factor = 2 if "cpu" in programs else 3
                np.testing.assert_array_equal(chosen(jnp.ones(3)), factor)
            assert settings == [is_quick] * is_first
            assert set(traced) == (programs if is_first else set())


def test_what_was_chosen_is_restored_after_an_error():
    before = jax.lax.platform_dependent, jax.config.read("jax_disable_most_optimizations")
    with pytest.raises(KeyError), optimised(), for_accelerators():
        raise KeyError
    assert before == (
        jax.lax.platform_dependent,
        jax.config.read("jax_disable_most_optimizations"),
    )
