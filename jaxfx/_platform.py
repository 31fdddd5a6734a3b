"""A program for CPUs beside one for accelerators, and how each takes a batch."""

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_batching import custom_vmap


def by_platform(
    *operands: Any, cpu: Callable[..., Any], accelerator: Callable[..., Any]
) -> Any:
    """`cpu(*operands)` where the program is lowered for a CPU, else `accelerator(*operands)`.

    The choice is made when a program is lowered: one `jit`ted function is right wherever it
    runs. Both functions are traced, so that neither may be long to trace.
    """
    return jax.lax.platform_dependent(*operands, cpu=cpu, default=accelerator)


def one_by_one_on_cpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of arrays, whose batch a CPU takes one by one and an accelerator at once.

    On a CPU each member of a batch then costs what it costs alone: a `cond` stays a `cond`, and
    a loop ends with its own data. On an accelerator one launch serves the whole batch.
    """

    @custom_vmap
    def one(*operands):
        return function(*operands)

    @one.def_vmap
    def batch(_size, is_batched, *operands):
        leaves, tree = jax.tree.flatten(operands)
        mapped = jax.tree.leaves(is_batched)
        moving = [x for x, moves in zip(leaves, mapped, strict=True) if moves]

        def member(moving, call):
            moving = iter(moving)
            every = [next(moving) if m else x for x, m in zip(leaves, mapped, strict=True)]
            return call(*jax.tree.unflatten(tree, every))

        in_turn = lambda moving: jax.lax.map(lambda x: member(x, one), moving)
        at_once = jax.vmap(lambda x: member(x, function))
        out = by_platform(moving, cpu=in_turn, accelerator=at_once)
        return out, jax.tree.map(lambda _: True, out)

    return one
