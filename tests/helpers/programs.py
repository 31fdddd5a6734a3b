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


# A precision of matrix products for accelerators by that for a CPU: see `for_accelerators`.
PRECISIONS = {None: "tensorfloat32", "highest": "float32"}


@contextlib.contextmanager
def for_accelerators() -> Iterator[None]:
    """Trace the programs for accelerators, whatever device they then run on.

    JAX caches traces by function, types and a few settings. The precision of matrix products
    is one of them and changes no value on a CPU, so it keeps apart what is traced in here, as
    in `tests.helpers.quick`.
    """

    def default(*operands: Any, default: Callable[..., Any], **_: Any) -> Any:
        return default(*operands)

    precision = PRECISIONS[jax.config.jax_default_matmul_precision]
    with (
        jax.default_matmul_precision(precision),
        mock.patch.object(jax.lax, "platform_dependent", default),
    ):
        yield
