"""The operations of programs."""

from collections.abc import Iterator
from typing import Any

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
