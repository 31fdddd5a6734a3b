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
def use_older_generator() -> None:
    """Compile what is little optimised by the older generator, where this release has both.

    That takes half the time. For the quick tests alone: of what `--full` adds it gets some
    wrong, a few pixels of a warp by one and sums that keep what rounding loses. Users have the
    newer one. No public setting reaches every compilation; a release without the private name
    that does is only slower.
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


class Kind(NamedTuple):
    """How a test compiles its programs, and for which devices it traces them."""

    is_optimised: bool
    is_for_accelerators: bool


# JAX caches traces and programs by function, types and a few settings. What is asked for here
# is none of them; the precision of matrix products is. It changes no value on a CPU, so it
# serves to keep the kinds of programs apart.
PRECISIONS = {
    Kind(is_optimised=True, is_for_accelerators=False): None,
    Kind(is_optimised=False, is_for_accelerators=False): "highest",
    Kind(is_optimised=True, is_for_accelerators=True): "tensorfloat32",
    Kind(is_optimised=False, is_for_accelerators=True): "float32",
}

_kind = Kind(is_optimised=True, is_for_accelerators=False)
_platform_dependent = jax.lax.platform_dependent


def _program_of_a_cpu(*operands: Any, **programs: Callable[..., Any]) -> Any:
    """The program for CPUs. Tracing takes half the time without the one for accelerators."""
    return (programs.get("cpu") or programs["default"])(*operands)


def _program_of_an_accelerator(*operands: Any, **programs: Callable[..., Any]) -> Any:
    """The program for accelerators."""
    return programs["default"](*operands)


def _replacement() -> Callable[..., Any]:
    """The function that tests call in place of `jax.lax.platform_dependent`, by `_kind`.

    JAX's own function traces the program of every platform and lowers one of them.
    """
    if _kind.is_for_accelerators:
        return _program_of_an_accelerator
    if not _kind.is_optimised and jax.default_backend() == "cpu":
        return _program_of_a_cpu
    return _platform_dependent


@contextlib.contextmanager
def _of_kind(**changes: bool) -> Iterator[None]:
    """Make programs of another kind in this context; fields not given stay as they are."""
    global _kind  # noqa: PLW0603
    before, _kind = _kind, _kind._replace(**changes)
    jax.config.update("jax_disable_most_optimizations", not _kind.is_optimised)
    try:
        with (
            jax.default_matmul_precision(PRECISIONS[_kind]),
            mock.patch.object(jax.lax, "platform_dependent", _replacement()),
        ):
            yield
    finally:
        _kind = before
        jax.config.update("jax_disable_most_optimizations", not _kind.is_optimised)


# With little optimisation, and the program for this platform alone.
quickly = functools.partial(_of_kind, is_optimised=False)
# As users do, with all optimisation.
optimised = functools.partial(_of_kind, is_optimised=True)
# The programs for accelerators, whatever device they then run on.
for_accelerators = functools.partial(_of_kind, is_for_accelerators=True)


def check_slopes(function: Callable[..., Any], arguments: tuple, **tolerances: float) -> None:
    """Compare first derivatives in both modes with finite differences, in three programs.

    `jax.test_util.check_grads` does the same and compiles each mode several times.
    """
    arguments = jax.device_get(arguments)  # Steps are added by NumPy, where nothing compiles.
    value, push = jax.jit(function), jax.jit(functools.partial(jax.jvp, function))
    pull = jax.jit(lambda at, weight: jax.vjp(function, *at)[1](weight))
    check_jvp(value, push, arguments, **tolerances)
    check_vjp(
        value, lambda *at: (value(*at), functools.partial(pull, at)), arguments, **tolerances
    )
