"""A program for CPUs beside one for accelerators, and how each takes a batch."""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap, sequential_vmap
from jaxtyping import Array, Bool


def by_platform(
    *operands: Any, cpu: Callable[..., Any], accelerator: Callable[..., Any]
) -> Any:
    """`cpu(*operands)` where the program is lowered for a CPU, else `accelerator(*operands)`.

    The choice is made when a program is lowered: one `jit`ted function is right wherever it
    runs. Both functions are traced, so that neither may be long to trace.
    """
    return jax.lax.platform_dependent(*operands, cpu=cpu, default=accelerator)


def one_by_one_on_cpu(
    function: Callable[..., Any], accelerator: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """`function` of arrays, whose batch a CPU takes one by one and an accelerator at once.

    On a CPU each member of a batch then costs what it costs alone: a `cond` stays a `cond`, and
    a loop ends with its own data. On an accelerator one launch serves the whole batch.
    `accelerator` is the function there, if it is another one.
    """
    elsewhere = function if accelerator is None else accelerator

    @custom_vmap
    def one(*operands):
        if elsewhere is function:
            return function(*operands)
        return by_platform(*operands, cpu=function, accelerator=elsewhere)

    @one.def_vmap
    def batch(_size, is_batched, *operands):
        in_turn, at_once = _in_turn(function, is_batched), _at_once(elsewhere, is_batched)
        out = by_platform(*operands, cpu=in_turn, accelerator=at_once)
        return out, jax.tree.map(lambda _: True, out)

    return one


def either(
    predicate: Callable[..., Bool[Array, ""]],
    short: Callable[..., Any],
    long: Callable[..., Any],
    *operands: Any,
) -> Any:
    """`short(*operands)` where `predicate(*operands)`, else `long(*operands)`, and that alone.

    A batch goes one by one on a CPU. On an accelerator, where to look at a predicate takes as
    long as a few launches, it is looked at once: where it holds for all, all take `short`.
    """
    choose = lambda *operands: jax.lax.cond(predicate(*operands), short, long, *operands)
    one = custom_vmap(choose)

    @one.def_vmap
    def batch(_size, is_batched, *operands):
        asks, shorts, longs = (_at_once(f, is_batched) for f in (predicate, short, long))
        ask_all = lambda *operands: asks(*operands).all()

        def each(*operands):
            # Not by a `cond`: what it closes over then has a batch axis too.
            select = jax.vmap(
                lambda asked, *two: jax.tree.map(ft.partial(jnp.where, asked), *two)
            )
            return select(asks(*operands), shorts(*operands), longs(*operands))

        at_once = lambda *operands: either(ask_all, shorts, each, *operands)
        out = by_platform(*operands, cpu=_in_turn(choose, is_batched), accelerator=at_once)
        return out, jax.tree.map(lambda _: True, out)

    return one(*operands)


def _in_turn(function: Callable[..., Any], is_batched: Any) -> Callable[..., Any]:
    """`function` of batches, one member after the other."""
    mapped = jax.tree.leaves(is_batched)
    single = sequential_vmap(function)  # in a batch of batches

    def loop(*operands):
        leaves, tree = jax.tree.flatten(operands)

        def member(moving):
            moving = iter(moving)
            every = [next(moving) if m else x for x, m in zip(leaves, mapped, strict=True)]
            return single(*jax.tree.unflatten(tree, every))

        return jax.lax.map(member, [x for x, m in zip(leaves, mapped, strict=True) if m])

    return loop


def _at_once(function: Callable[..., Any], is_batched: Any) -> Callable[..., Any]:
    """`function` of batches, of all members together."""
    return jax.vmap(function, jax.tree.map(lambda moves: 0 if moves else None, is_batched))
