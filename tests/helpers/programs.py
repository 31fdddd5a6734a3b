"""What programs hold, and those for accelerators on a CPU."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import jax
from jax.extend import core


def primitives(jaxpr: Any, skip: tuple[str, ...] = ()) -> Iterator[str]:
    """The names of all operations, but for those inside of what is skipped."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        if equation.primitive.name not in skip:
            for inner in jax.tree.leaves(
                equation.params, is_leaf=lambda x: isinstance(x, core.ClosedJaxpr | core.Jaxpr)
            ):
                if isinstance(inner, core.ClosedJaxpr | core.Jaxpr):
                    yield from primitives(getattr(inner, "jaxpr", inner), skip)


@contextlib.contextmanager
def for_accelerators() -> Iterator[None]:
    """Trace the programs for accelerators, whatever they then run on."""

    def default(*operands: Any, default: Callable[..., Any], **_: Any) -> Any:
        return default(*operands)

    # What was traced before knows the other program, and what is traced here this one.
    jax.clear_caches()
    try:
        with mock.patch.object(jax.lax, "platform_dependent", default):
            yield
    finally:
        jax.clear_caches()
