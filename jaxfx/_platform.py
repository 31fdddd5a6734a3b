"""A program for CPUs beside one for accelerators, and how each takes a batch."""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

from jaxfx._loops import alike, cond
from jaxfx._meshes import each_device


def by_platform(
    *operands: Any, cpu: Callable[..., Any], accelerator: Callable[..., Any]
) -> Any:
    """`cpu(*operands)` where the program is lowered for a CPU, else `accelerator(*operands)`.

    The choice is made when a program is lowered: one `jit`ted function is right wherever it
    runs. Both functions are traced, so that neither may be long to trace.
    """
    (cpu, accelerator), operands = alike((cpu, accelerator), *operands)
    return jax.lax.platform_dependent(*operands, cpu=cpu, default=accelerator)


def kept(arrays: Any) -> Any:
    """The arrays as they are, which an accelerator computes once and keeps in memory.

    XLA else keeps all that they are computed from, and each reader computes them again.
    """
    return by_platform(arrays, cpu=lambda x: x, accelerator=jax.lax.optimization_barrier)


def one_by_one_on_cpu(
    function: Callable[..., Any], accelerator: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """`function` of arrays, whose batch a CPU takes one by one and an accelerator at once.

    On a CPU each member of a batch then costs what it costs alone: a `cond` stays a `cond`, and
    a loop ends with its own data. On an accelerator one launch serves the whole batch.
    `accelerator` is the function there, if it is another one. Of a batch that is spread over
    devices, each device computes its own members.
    """
    return of_batches(function, function if accelerator is None else accelerator, ())


def at_once(
    function: Callable[..., Any], accelerator: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """`function` of arrays, which takes a batch at once, and on each device its own members.

    A loop that ends with its data would else ask all devices whether it goes on.
    """
    return of_batches(function, function if accelerator is None else accelerator, (), _at_once)


def of_batches(
    cpu: Callable[..., Any],
    accelerator: Callable[..., Any],
    levels: tuple[list[bool], ...],
    rule_on_cpu: Callable[[Callable[..., Any], Any], Callable[..., Any]] | None = None,
) -> Callable[..., Any]:
    """A function of arrays that have `levels` axes of batches already, outermost first.

    - `cpu`, `accelerator`: the function as lowered for either.
    - `levels`: of each of these axes, which of the operands' leaves have it.
    - `rule_on_cpu`: makes of a function the function of one more batch, given which leaves have
      that axis; one by one if it is left out.
    """

    def chosen(*operands):
        if accelerator is cpu:
            return cpu(*operands)
        return by_platform(*operands, cpu=cpu, accelerator=accelerator)

    unbatched = custom_vmap(each_device(chosen, levels) if levels else chosen)
    rule = rule_on_cpu or _in_turn

    @unbatched.def_vmap
    def batch(_size, is_batched, *operands):
        on_cpu, elsewhere = rule(cpu, is_batched), _at_once(accelerator, is_batched)
        if rule is _at_once and cpu is accelerator:
            # The same object, so that `chosen` sees that one program serves both.
            elsewhere = on_cpu
        all_levels = (jax.tree.leaves(is_batched), *levels)
        out = of_batches(on_cpu, elsewhere, all_levels, rule_on_cpu)(*operands)
        return out, jax.tree.map(lambda _: True, out)

    return unbatched


def of_directions(tangents: Callable[[Any, Any], Array]) -> Callable[[Any, Any], Array]:
    """`tangents(point, dots)`, of which a batch of directions at one point is one call.

    The first axis of each leaf of `dots`, and of the result, is that of the directions. So the
    derivatives of one image in several parameters share what depends on the image alone. Of a
    batch of points, each with its directions, `tangents` knows how it is taken.
    """
    of_all = custom_vmap(tangents)
    swapped = lambda x: jnp.swapaxes(x, 0, 1)

    @of_all.def_vmap
    def batch(size, is_batched, point, dots):
        per_point, per_dots = is_batched
        dots = jax.tree.map(
            lambda x, has_axis: x if has_axis else jnp.broadcast_to(x, (size, *x.shape)),
            dots,
            per_dots,
        )
        if any(jax.tree.leaves(per_point)):
            axes = jax.tree.map(lambda has_axis: 0 if has_axis else None, per_point)
            of_points = of_directions(jax.vmap(tangents, (axes, 1), 1))
            return swapped(of_points(point, jax.tree.map(swapped, dots))), True
        out = of_all(point, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), dots))
        return out.reshape(size, -1, *out.shape[1:]), True

    return of_all


def in_groups(tangents: Callable[..., Array], most: int) -> Callable[..., Array]:
    """`tangents(static, point, dots)`, computed for at most `most` directions at once.

    Many directions then take no more memory than a group.
    """

    def grouped(static: Any, point: Any, dots: Any) -> Array:
        count = len(jax.tree.leaves(dots)[0])
        groups = -(-count // most)
        if groups == 1:
            return tangents(static, point, dots)
        size = -(-count // groups)

        def split(x):
            rest = [(0, groups * size - count), *[(0, 0)] * (x.ndim - 1)]
            return jnp.pad(x, rest).reshape(groups, size, *x.shape[1:])

        of_group = ft.partial(tangents, static, point)
        out = jax.lax.map(of_group, jax.tree.map(split, dots))
        return out.reshape(-1, *out.shape[2:])[:count]

    return grouped


def one_by_one(tangent: Callable[..., Array]) -> Callable[..., Array]:
    """`tangents(static, point, dots)` of a `tangent(static, point, dot)`, which takes one."""

    def alone(static: Any, point: Any, dots: Any) -> Array:
        return tangent(static, point, jax.tree.map(lambda x: x[0], dots))[None]

    return in_groups(alone, 1)


def either(
    predicate: Callable[..., Bool[Array, ""]],
    short: Callable[..., Any],
    long: Callable[..., Any],
    *operands: Any,
) -> Any:
    """`short(*operands)` where `predicate(*operands)`, else `long(*operands)`, and that alone.

    On a CPU each member of a batch takes its own branch. On an accelerator a branch waits for
    its predicate, for as long as a few launches take: there is one branch for the whole batch.
    If the predicate holds for all members, all take `short`; else both functions are computed
    and each member's result is selected.
    """
    return _either(predicate, short, long)(*operands)


def _either(predicate, short, long) -> Callable[..., Any]:
    choose = lambda *operands: cond(predicate(*operands), short, long, *operands)
    unbatched = custom_vmap(choose)

    @unbatched.def_vmap
    def batch(_size, is_batched, *operands):
        predicates, shorts, longs = (_at_once(f, is_batched) for f in (predicate, short, long))
        holds_for_all = lambda *operands: predicates(*operands).all()

        def selected(*operands):
            # Not by a `cond`: what it closes over then has a batch axis too.
            select = jax.vmap(
                lambda holds, *pair: jax.tree.map(ft.partial(jnp.where, holds), *pair)
            )
            return select(predicates(*operands), shorts(*operands), longs(*operands))

        in_turn = _in_turn(choose, is_batched)
        together = _either(holds_for_all, shorts, selected)
        out = of_batches(in_turn, together, (jax.tree.leaves(is_batched),))(*operands)
        return out, jax.tree.map(lambda _: True, out)

    return unbatched


def _in_turn(function: Callable[..., Any], is_batched: Any) -> Callable[..., Any]:
    """`function` of batches, one member after the other."""
    mapped = jax.tree.leaves(is_batched)

    def loop(*operands):
        leaves, tree = jax.tree.flatten(operands)

        def member(mapped_leaves):
            of_member = iter(mapped_leaves)
            operands = [
                next(of_member) if has_batch else leaf
                for leaf, has_batch in zip(leaves, mapped, strict=True)
            ]
            return function(*jax.tree.unflatten(tree, operands))

        return jax.lax.map(member, [x for x, m in zip(leaves, mapped, strict=True) if m])

    return loop


def _at_once(function: Callable[..., Any], is_batched: Any) -> Callable[..., Any]:
    """`function` of batches, of all members together."""
    return jax.vmap(
        function, jax.tree.map(lambda has_batch: 0 if has_batch else None, is_batched)
    )
