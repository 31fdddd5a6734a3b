"""Compilation with little optimisation, for tests that measure neither speed nor memory."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax._src import compiler
from jax.test_util import check_jvp, check_vjp


# An option of JAX 0.10, which has two generators of code for the CPU: the newer one, its
# default, sets up a compiler for every program. Later releases have the newer one alone.
FUSION_EMITTERS = "xla_cpu_use_fusion_emitters"


@functools.cache
def _use_older_generator() -> None:
    """Compile what is little optimised by the older generator, where this release has both.

    That takes half the time. No public setting reaches every compilation; a release without
    the private name that does is only slower.
    """
    try:
        jax.jit(lambda x: x, compiler_options={FUSION_EMITTERS: False})(0.0)
        get_options = compiler.get_compile_options
    except (jax.errors.JaxRuntimeError, AttributeError):
        return

    def options(*args: Any, **kwargs: Any) -> Any:
        chosen = get_options(*args, **kwargs)
        if jax.config.read("jax_disable_most_optimizations"):
            others = chosen.env_option_overrides
            chosen.env_option_overrides = [*others, (FUSION_EMITTERS, False)]
        return chosen

    compiler.get_compile_options = options


@contextlib.contextmanager
def _compiled(is_optimised: bool) -> Iterator[None]:
    """Compile with all optimisation, or with little, in this context.

    JAX caches compiled programs by function, types and a few settings. Optimisation is not one
    of them; the precision of matrix products is. It changes no value on a CPU, so it serves to
    keep the two kinds of programs apart.
    """
    _use_older_generator()
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
