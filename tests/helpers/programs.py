"""The operations of programs; and tracing of the programs for accelerators, on a CPU."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import jax
from jax.extend import core


def primitives(jaxpr: Any, skip: tuple[str, ...] = ()) -> Iterator[str]:
    """The names of all operations, except those inside operations named in `skip`."""
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
    """Trace the programs for accelerators, whatever device they then run on."""

    def default(*operands: Any, default: Callable[..., Any], **_: Any) -> Any:
        return default(*operands)

    # Traces made outside hold the CPU's program, and those made inside the accelerator's.
    jax.clear_caches()
    try:
        with mock.patch.object(jax.lax, "platform_dependent", default):
            yield
    finally:
        jax.clear_caches()
