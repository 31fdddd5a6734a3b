"""How tests make programs: with little optimisation or all, for a CPU or for accelerators."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple
from unittest import mock

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


class Made(NamedTuple):
    """How programs are made, in a test."""

    is_optimised: bool
    is_for_accelerators: bool


# JAX caches traces and programs by function, types and a few settings. What is asked for here
# is none of them; the precision of matrix products is. It changes no value on a CPU, so it
# serves to keep the kinds of programs apart.
PRECISIONS = {
    Made(True, False): None,
    Made(False, False): "highest",
    Made(True, True): "tensorfloat32",
    Made(False, True): "float32",
}

_made = Made(is_optimised=True, is_for_accelerators=False)
_choose = jax.lax.platform_dependent


def _program_of_a_cpu(*operands: Any, **programs: Callable[..., Any]) -> Any:
    """The program for a CPU alone: not to trace the other one halves the time to trace."""
    return (programs.get("cpu") or programs["default"])(*operands)


def _program_of_an_accelerator(*operands: Any, **programs: Callable[..., Any]) -> Any:
    return programs["default"](*operands)


def _choice() -> Callable[..., Any]:
    """What stands for `jax.lax.platform_dependent`, which traces the programs of all."""
    if _made.is_for_accelerators:
        return _program_of_an_accelerator
    is_quick_on_cpu = not _made.is_optimised and jax.default_backend() == "cpu"
    return _program_of_a_cpu if is_quick_on_cpu else _choose


@contextlib.contextmanager
def _making(**changes: bool) -> Iterator[None]:
    """Make programs another way in this context."""
    global _made  # noqa: PLW0603
    _use_older_generator()
    before, _made = _made, _made._replace(**changes)
    jax.config.update("jax_disable_most_optimizations", not _made.is_optimised)
    try:
        with (
            jax.default_matmul_precision(PRECISIONS[_made]),
            mock.patch.object(jax.lax, "platform_dependent", _choice()),
        ):
            yield
    finally:
        _made = before
        jax.config.update("jax_disable_most_optimizations", not _made.is_optimised)


# With little optimisation, and the program for this platform alone.
quickly = functools.partial(_making, is_optimised=False)
# As users do, with all optimisation.
optimised = functools.partial(_making, is_optimised=True)
# The programs for accelerators, whatever device they then run on.
for_accelerators = functools.partial(_making, is_for_accelerators=True)


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
