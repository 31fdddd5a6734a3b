"""Programs that are quick to compile, for what is asked of neither speed nor memory."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.test_util import check_jvp, check_vjp


# Compiling is most of the tests' work. What a user runs is compiled with all optimisation: that
# it is right too is shown by tests of values, which call `jax.jit` or the function alone.
quick_jit = functools.partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 0,
        "xla_cpu_use_fusion_emitters": False,
    },
)


@contextlib.contextmanager
def quickly() -> Iterator[None]:
    """What is compiled meanwhile, within calls too, is compiled with little optimisation."""
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


def check_slopes(function: Callable[..., Any], arguments: tuple, **tolerances: float) -> None:
    """What `jax.test_util.check_grads` checks of first order, in three programs: forward and
    reverse mode against differences."""
    value, push = quick_jit(function), quick_jit(functools.partial(jax.jvp, function))
    pull = quick_jit(lambda at, weight: jax.vjp(function, *at)[1](weight))
    check_jvp(value, push, arguments, **tolerances)
    check_vjp(
        value, lambda *at: (value(*at), functools.partial(pull, at)), arguments, **tolerances
    )
