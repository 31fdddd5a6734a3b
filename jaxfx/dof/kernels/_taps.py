"""The term of one tap in the sums of scatter, and its derivatives, for any sweep over taps."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import clip01
from jaxfx.dof.sprites import Sprites


# Circle of confusion of a background source, in epsilons, from which on the leak rejection does
# not depend on it: a target that rejects has less than 2, so that the clamp of the difference
# is 1. Follows from `leak_rejection`: a smaller number is wrong, a larger one only slower.
UNCOUPLED = 3.0


class Sweep(NamedTuple):
    """A program that visits all taps.

    `sums(tap, reach, radius, own, other, *, by_source, slopes)` gives, for every pixel, what
    `tap(cover, slope, own, other)` sums to over the offsets about it: a list of planes or of
    stacks. `own` are the planes at the pixel and `other` those at the offset, one or a stack of
    them, which may be handed to `tap` as a list of planes where that compiles better. The
    sprite is the pixel's own where `by_source`, else the other's; `cover` is its coverage at
    the offset and `slope`, given where `slopes` are asked for, the derivative of that in its
    radius.

    `clip` clamps to [0, 1], in the form that compiles best for the sweep's device.
    """

    sums: Callable[..., list[Array]]
    clip: Callable[[Array], Array]


Stack = TypeVar("Stack", Array, list[Array])


class Planes(NamedTuple):
    """Sprites as the kernel reads them, with `leak` and `coc` in units of epsilon."""

    value: Float[Array, "value height width"]
    radius: Float[Array, "height width"]
    leak: Float[Array, "height width"]
    coc: Float[Array, "height width"]


def to_planes(sprites: Sprites) -> Planes:
    """The sprites as the kernel reads them."""
    value, radius, leak, coc, epsilon = sprites
    return Planes(stacked(value), radius, leak / epsilon, coc / epsilon)


def stacked(value: Float[Array, "height width value"]) -> Float[Array, "value height width"]:
    """The channels as planes."""
    return jnp.moveaxis(value, -1, 0)


def scaled(weight: Float[Array, "*size"], stack: Stack) -> Stack:
    """Each plane of a stack, or array of a list, times the weight."""
    if isinstance(stack, list):
        return [weight * plane for plane in stack]
    return weight[None] * stack


def forward(sweep: Sweep, reach: int, planes: Planes) -> Float[Array, "value height width"]:
    """The sums themselves."""
    value, radius, leak, coc = planes

    def tap(cover, own, other):
        coc, sharp = own
        value, leak = other
        weight = cover * (1 - sharp * sweep.clip(leak - coc))
        return [scaled(weight, value)]

    own, other = [coc, 1 - clip01(coc - 1)], [value, leak]
    (sums,) = sweep.sums(tap, reach, radius, own, other, by_source=False, slopes=False)
    return sums


def tangent(
    sweep: Sweep, reach: int, planes: Planes, dot: Planes
) -> Float[Array, "value height width"]:
    """Their derivative along `dot`."""
    value, radius, leak, coc = planes

    def tap(cover, slope, own, other):
        coc, coc_dot, sharp, blurring = own
        value, value_dot, leak, leak_dot, radius_dot = other
        rise = leak - coc
        weight = 1 - sharp * sweep.clip(rise)
        weight_dot = sharp * inside(rise) * (coc_dot - leak_dot)
        weight_dot = weight_dot + blurring * coc_dot * sweep.clip(rise)
        product_dot = slope * radius_dot * weight + cover * weight_dot
        moved = scaled(product_dot, value), scaled(cover * weight, value_dot)
        return [jax.tree.map(jnp.add, *moved)]

    own = [coc, dot.coc, 1 - clip01(coc - 1), inside(coc - 1)]
    other = [value, dot.value, leak, dot.leak, dot.radius]
    (sums,) = sweep.sums(tap, reach, radius, own, other, by_source=False, slopes=True)
    return sums


def adjoint(
    sweep: Sweep, reach: int, planes: Planes, bar: Float[Array, "value height width"]
) -> Planes:
    """The transpose of `tangent`: one sweep owned by the sources, one by the destinations."""
    value, radius, leak, coc = planes
    sharp, blurring = 1 - clip01(coc - 1), inside(coc - 1)

    def to_source(cover, slope, own, other):
        value, leak = own
        bar, coc, sharp = other
        rise = leak - coc
        weight = 1 - sharp * sweep.clip(rise)
        product = sum(x * y for x, y in zip(value, bar, strict=True))
        leak_bar = -cover * sharp * inside(rise) * product
        return [scaled(cover * weight, bar), slope * weight * product, leak_bar]

    def to_destination(cover, own, other):
        bar, coc, sharp, blurring = own
        value, leak = other
        rise = leak - coc
        product = sum(x * y for x, y in zip(value, bar, strict=True))
        return [cover * (sharp * inside(rise) + blurring * sweep.clip(rise)) * product]

    own, other = [value, leak], [bar, coc, sharp]
    value_bar, radius_bar, leak_bar = sweep.sums(
        to_source, reach, radius, own, other, by_source=True, slopes=True
    )
    own, other = [bar, coc, sharp, blurring], [value, leak]
    (coc_bar,) = sweep.sums(
        to_destination, reach, radius, own, other, by_source=False, slopes=False
    )
    return Planes(value_bar, radius_bar, leak_bar, coc_bar)


def clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Clamp to [0, 1], by comparisons that compile to one instruction each."""
    x = jnp.where(x > 0, x, 0)
    return jnp.where(x < 1, x, 1)


def inside(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The derivative of `clip`, at its kinks the one from above."""
    return ((x >= 0) & (x < 1)).astype(x.dtype)
