"""JAX's loops and branches, also where their data vary over the devices of a mesh.

Inside `jax.shard_map` a value either varies over an axis of the mesh or is the same on all its
devices, and a loop keeps the kind of what it carries. A carry begins as a constant, which is
the same everywhere, and ends as a sum of data, which vary. These functions mark the beginning
as varying over all axes over which the end varies. Outside `shard_map` they are those of
`jax.lax`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax


def scan(
    body: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    xs: Any = None,
    length: int | None = None,
    **options: Any,
) -> tuple[Any, Any]:
    """`jax.lax.scan`."""
    if not _manual_axes():
        return jax.lax.scan(body, carry, xs, length, **options)
    first = lambda carry, xs: body(carry, jax.tree.map(lambda x: x[0], xs))[0]
    axes = _axes_after(first, carry, xs)

    def same_kind(carry: Any, row: Any) -> tuple[Any, Any]:
        carry, out = body(carry, row)
        return _varying(carry, axes), out

    return jax.lax.scan(same_kind, _varying(carry, axes), xs, length, **options)


def fori_loop(
    lower: Any, upper: Any, body: Callable[[Any, Any], Any], carry: Any, **options: Any
) -> Any:
    """`jax.lax.fori_loop`."""
    if not _manual_axes():
        return jax.lax.fori_loop(lower, upper, body, carry, **options)
    axes = _axes_after(lambda carry, index, _: body(index, carry), carry, lower, upper)
    same_kind = lambda index, carry: _varying(body(index, carry), axes)
    return jax.lax.fori_loop(lower, upper, same_kind, _varying(carry, axes), **options)


def while_loop(goes_on: Callable[[Any], Any], body: Callable[[Any], Any], carry: Any) -> Any:
    """`jax.lax.while_loop`."""
    if not _manual_axes():
        return jax.lax.while_loop(goes_on, body, carry)
    axes = _axes_after(body, carry)
    same_kind = lambda carry: _varying(body(carry), axes)
    return jax.lax.while_loop(goes_on, same_kind, _varying(carry, axes))


def cond(
    predicate: Any, yes: Callable[..., Any], no: Callable[..., Any], *operands: Any
) -> Any:
    """`jax.lax.cond`."""
    (yes, no), operands = alike((yes, no), *operands, index=predicate)
    return jax.lax.cond(predicate, yes, no, *operands)


def switch(index: Any, branches: Sequence[Callable[..., Any]], *operands: Any) -> Any:
    """`jax.lax.switch`."""
    branches, operands = alike(branches, *operands, index=index)
    return jax.lax.switch(index, branches, *operands)


def alike(
    branches: Sequence[Callable[..., Any]], *operands: Any, index: Any = None
) -> tuple[Sequence[Callable[..., Any]], tuple]:
    """Functions of the same operands whose results vary over the same axes; and the operands.

    These vary over all axes over which what chooses, `index`, or a result does: `vmap` makes a
    `select` of a branch, whose operands JAX then marks, and must not find marked later on.
    """
    if not _manual_axes():
        return branches, operands
    axes = _axes(operands, index)
    # Where all varies already, the branches need not be traced to see it.
    if axes != frozenset(_manual_axes()):
        axes = _axes([jax.eval_shape(branch, *operands) for branch in branches], index)
    marked = [
        lambda *operands, branch=branch: _varying(branch(*operands), axes)
        for branch in branches
    ]
    return marked, _varying(operands, axes)


def varying_as(data: Any, tree: Any) -> Any:
    """The values of `tree`, marked as varying over all axes over which an array of `data` does.

    A tangent must vary as what it is the tangent of; a carry that begins so is traced once.
    """
    if not _manual_axes():
        return tree
    arrays = [leaf for leaf in jax.tree.leaves(data) if isinstance(leaf, jax.Array)]
    return _varying(tree, _axes(arrays))


def _manual_axes() -> tuple[str, ...]:
    """The axes of the mesh over which an enclosing `shard_map` maps."""
    return jax.sharding.get_abstract_mesh().manual_axes


def _axes(*trees: Any) -> frozenset[str]:
    """All axes over which a leaf of the trees varies; none where `shard_map` checks nothing."""

    def axes(leaf: Any) -> frozenset[str]:
        shape: Any = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
        kind = shape.manual_axis_type
        return frozenset() if kind is None else kind.varying

    return frozenset[str]().union(*map(axes, jax.tree.leaves(trees)))


def _axes_after(step: Callable[..., Any], *data: Any) -> frozenset[str]:
    """The axes over which a carry varies after `step` of it and other data, or any of these.

    Once is enough: what the step closes over is then in too. Where nothing is carried, or all
    varies already, the step need not be traced to see it.
    """
    before = _axes(data)
    if not jax.tree.leaves(data[0]) or before == frozenset(_manual_axes()):
        return before
    return before | _axes(jax.eval_shape(step, *data))


def _varying(tree: Any, axes: frozenset[str]) -> Any:
    """The same values, marked as varying over these axes."""

    def mark(leaf: Any) -> Any:
        missing = tuple(sorted(axes - _axes(leaf)))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(mark, tree)
