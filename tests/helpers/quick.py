"""Compilation with little optimisation, for tests that measure neither speed nor memory."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.test_util import check_jvp, check_vjp


@contextlib.contextmanager
def _compiled(is_optimised: bool) -> Iterator[None]:
    """Compile with all optimisation, or with little, in this context.

    JAX caches compiled programs by function, types and a few settings. Optimisation is not one
    of them; the precision of matrix products is. It changes no value on a CPU, so it serves to
    keep the two kinds of programs apart.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", not is_optimised)
    try:
        with jax.default_matmul_precision(None if is_optimised else "highest"):
            yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


quickly = functools.partial(_compiled, False)
optimised = functools.partial(_compiled, True)


def check_slopes(function: Callable[..., Any], arguments: tuple, **tolerances: float) -> None:
    """Compare first derivatives in both modes with finite differences, in three programs.

    `jax.test_util.check_grads` does the same and compiles each mode several times.
    """
    value, push = jax.jit(function), jax.jit(functools.partial(jax.jvp, function))
    pull = jax.jit(lambda at, weight: jax.vjp(function, *at)[1](weight))
    check_jvp(value, push, arguments, **tolerances)
    check_vjp(
        value, lambda *at: (value(*at), functools.partial(pull, at)), arguments, **tolerances
    )
