"""Searches under a transform: one program of them, of a batch one by one where each lies.

Outside of transforms a search is Python that looks at every step. Under `jit` and `vmap` the
same code is traced, with the loops and choices of the program in place of Python's.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._platform import one_by_one_on_cpu


def joined(losses: list[Float[Array, "..."]]) -> Float[Array, " steps"]:
    """The losses of all searches in their order; under a transform NaN fills up the end."""
    flat = jnp.concatenate([jnp.reshape(loss, -1) for loss in losses])
    if is_concrete(flat):
        return flat
    return flat[jnp.argsort(jnp.isnan(flat), stable=True)]


def fitted_under_transform(
    fit: Callable[[Any], Any],
    data: Any,
    function: str,
    throw: bool,
    progress: bool,
    solver: Any,
) -> Any:
    """`fit(data)` where `data`, a pytree, is traced: of a batch, each device fits its own.

    `ValueError` for options of `function` that only a search outside of transforms has.
    """
    for name, value in (("throw", throw), ("progress", progress)):
        if value:
            raise ValueError(
                f"`{function}({name}=...)` must be False under `jit` and `vmap`, where a "
                f"search can neither raise nor print, got {value!r}."
            )
    if solver is not None and jax.sharding.get_abstract_mesh().manual_axes:
        raise ValueError(
            f"`{function}(solver=...)` must be None inside `jax.shard_map`, of which "
            "optimistix knows nothing: `jit(vmap(...))` of a sharded batch takes any solver, "
            f"got {solver!r}."
        )
    arrays, static = eqx.partition(data, eqx.is_array)
    of_arrays = one_by_one_on_cpu(lambda arrays: fit(eqx.combine(arrays, static)))
    return on_any_mesh(of_arrays)(arrays)


def each(function: Callable[[Any], Any], items: Sequence[Any] | Array, data: Any) -> list[Any]:
    """`function` of each item; where it depends on traced `data`, one program for all."""
    if is_concrete(data):
        return [function(item) for item in items]
    rows = items if isinstance(items, jax.Array) else stacked(items)
    mapped = scan(lambda _, item: (None, function(item)), None, rows)[1]
    return [jax.tree.map(lambda leaf, at=at: leaf[at], mapped) for at in range(len(items))]


def stacked(trees: Sequence[Any]) -> Any:
    """Trees of one structure as one of arrays with a first axis more."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
