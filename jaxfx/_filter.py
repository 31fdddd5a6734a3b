"""Separable symmetric filters.

A pass reads its image once and writes it once. Its transpose is the same pass, with zeros
beyond the frame.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxfx._linear import linear
from jaxfx._loops import fori_loop
from jaxfx._xla import added, added_in_groups


Sampling = Literal["discrete", "linear"]
# A pass is a sum over taps, the arrays that `tap(i)` gives; they differ in their offset only.
Tap = Callable[[int], Array]


@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def separable(
    sampling: Sampling,
    image: Float[Array, "h w c"],
    down: Float[Array, "taps"],
    across: Float[Array, "taps"],
) -> Float[Array, "h w c"]:
    """Down the columns, then along the rows, by symmetric weights."""
    down, across = down.astype(image.dtype), across.astype(image.dtype)
    if down.size == 1 or image.shape[1] < down.size:
        return _padded(sampling, image, down, across)
    return _unpadded(sampling, image, down, across)


@ft.partial(separable.defjvp, symbolic_zeros=True)
def _(sampling, primals, tangents):
    (image, *weights), (image_dot, *weights_dot) = primals, tangents
    dot = filter_tangent(image_dot, *weights)
    if any(not isinstance(each, SymbolicZero) for each in weights_dot):
        # Asked for by second derivatives in `sigma` alone.
        along = tuple(map(_materialized, weights_dot))
        by_weights = ft.partial(_padded, "discrete", image)
        dot = dot + jax.jvp(by_weights, tuple(weights), along)[1]
    return separable(sampling, *primals), dot


def filter_tangent(
    dot: Float[Array, "h w c"] | SymbolicZero, *weights: Float[Array, "taps"]
) -> Float[Array, "h w c"]:
    """The filter of an image's tangent, to be transposed as quickly as it is computed."""
    if isinstance(dot, SymbolicZero):
        return _materialized(dot)
    push = lambda x: separable("discrete", x, *weights)
    plain = lambda x: _padded("discrete", x, *weights)
    if min(dot.shape[:2]) < weights[0].size:
        return plain(dot)
    return linear(push, lambda bar: _transposed(bar, *weights), plain, dot)


def _materialized(dot: Any) -> Array:
    shape, dtype = dot.shape, dot.dtype
    return jnp.zeros(shape, dtype) if isinstance(dot, SymbolicZero) else dot


def _transposed(
    bar: Float[Array, "h w c"], *weights: Float[Array, "taps"]
) -> Float[Array, "h w c"]:
    """The transpose of `separable`: itself, but what leaves the frame returns to its border."""
    half = weights[0].size // 2
    wide = jnp.pad(bar, ((half, half), (half, half), (0, 0)))
    return folded(separable("discrete", wide, *weights), half)


def folded(wide: Float[Array, "H W c"], margin: int) -> Float[Array, "h w c"]:
    """The transpose of a margin that repeats the border: the sum of what is beyond it."""
    if margin == 0:
        return wide  # of one row, say, which would be first and last
    for axis in (0, 1):
        first, inside, last = jnp.split(wide, (margin + 1, wide.shape[axis] - margin - 1), axis)
        ends = (jnp.sum(end, axis, keepdims=True) for end in (first, last))
        wide = jnp.concatenate([next(ends), inside, next(ends)], axis)
    return wide


def _padded(
    sampling: Sampling,
    image: Float[Array, "h w c"],
    down: Float[Array, "taps"],
    across: Float[Array, "taps"],
) -> Float[Array, "h w c"]:
    """By copies with a margin: for small images, and for JAX to differentiate."""
    height, width, channels = image.shape
    half, terms = down.size // 2, _TERMS[sampling]
    margin = ((half, half), (half, half), (0, 0))
    wide = jnp.pad(image, margin, mode="edge").reshape(height + 2 * half, -1)
    columns = added(terms(down, lambda i: lax.slice_in_dim(wide, i, i + height)))
    row = width * channels

    def beside(i: int) -> Array:
        return lax.slice_in_dim(columns, i * channels, i * channels + row, axis=1)

    return added(terms(across, beside)).reshape(image.shape)


def _unpadded(
    sampling: Sampling,
    image: Float[Array, "h w c"],
    down: Float[Array, "taps"],
    across: Float[Array, "taps"],
) -> Float[Array, "h w c"]:
    """Without a copy of the image: it is read once and written once by each pass.

    Along the rows, a tap is the flat image moved by some pixels, which runs on into the next
    row at either border. There the result is computed apart, in two strips, and then put in.
    """
    height, width, channels = image.shape
    half, terms = down.size // 2, _TERMS[sampling]
    row, reach = width * channels, half * channels

    columns = _columns(ft.partial(terms, down), image.reshape(height, row), half).reshape(-1)

    def moved(i: int) -> Array:
        start = row + (i - half) * channels
        return lax.slice_in_dim(columns, start, start + height * row)

    whole = added_in_groups(image, terms(across, moved)).reshape(height, row)

    edges = [jnp.repeat(image[:, i : i + 1], half, axis=1) for i in (0, width - 1)]
    ends = [image[:, : 2 * half], image[:, width - 2 * half :]]
    sides = jnp.concatenate([edges[0], *ends, edges[1]], axis=1).reshape(height, -1)
    sides = _columns(ft.partial(terms, down), sides, half)

    def beside(i: int) -> Array:
        return lax.slice_in_dim(sides, i * channels, i * channels + 4 * reach, axis=1)

    sides = added_in_groups(image, terms(across, beside))

    # In a loop: outside of one, XLA computes the whole again to put a strip into it.
    def put(i: Array, whole: Array) -> Array:
        strip = lax.dynamic_slice(sides, (1, i * (3 * reach)), (height, reach))
        return lax.dynamic_update_slice(whole, strip, (0, i * (row - reach)))

    return fori_loop(0, 2, put, whole).reshape(image.shape)


def _columns(
    terms: Callable[[Tap], list[Callable[[], Array]]], flat: Float[Array, "h wc"], half: int
) -> Float[Array, "h+2 wc"]:
    """The pass down the columns, with a row of zeros above and one below.

    Rows are named by their index, held within the image. XLA keeps in memory what is padded,
    where it would compute a bare sum again for every tap that reads it.
    """
    height = flat.shape[0]
    indices = np.arange(height)[:, None] + np.arange(-half, half + 1)
    indices = jnp.asarray(indices.clip(0, height - 1))
    sums = added_in_groups(
        flat, terms(lambda i: flat.at[indices[:, i]].get(mode="promise_in_bounds"))
    )
    return lax.pad(sums, jnp.zeros((), flat.dtype), ((1, 1, 0), (0, 0, 0)))


def linear_reads(weights: Float[Array, "taps"]) -> list[tuple[int, Array, Array]]:
    """Reads of linear sampling: the first tap, the second's share, and the weight of both.

    The first tap is static. A read of one tap alone has a share of 0.
    """
    taps = weights.size
    half = taps // 2
    lone = (taps + half) % 2  # whether the middle is a read of its own
    right = [(i, i + 1) for i in range(half + lone, taps, 2)]
    left = [(taps - 1 - j, taps - 1 - i) for i, j in reversed(right)]
    if taps % 2 and not lone:
        weights = weights.at[half].divide(2)
    # Below this a share changes no sum, and its derivatives would overflow.
    least = jnp.finfo(weights.dtype).tiny ** 0.25
    reads = []
    for i, j in left + [(taps - 1 - half, half)] * lone + right:
        if i == j:
            reads.append((i, jnp.zeros_like(weights[i]), weights[i]))
        else:
            total = weights[i] + weights[j]
            is_seen = total > least
            share = jnp.where(is_seen, weights[j] / jnp.where(is_seen, total, 1), 0)
            reads.append((i, share, total))
    return reads


def discrete_terms(weights: Float[Array, "taps"], tap: Tap) -> list[Callable[[], Array]]:
    """The terms of the weighted sum: two taps that share a weight are added first."""
    last = weights.size - 1
    pairs = [
        lambda i=i: weights[i] * (tap(i) + tap(last - i)) for i in range(weights.size // 2)
    ]
    middle = [lambda: weights[last // 2] * tap(last // 2)] if weights.size % 2 else []
    return middle + pairs


def _linear(weights: Float[Array, "taps"], tap: Tap) -> list[Callable[[], Array]]:
    """The terms of the same sum by half as many reads, each between two taps."""

    def read(i: int, share: Array, is_lone: bool) -> Array:
        return tap(i) if is_lone else tap(i) + share * (tap(i + 1) - tap(i))

    middle = weights.size // 2 if weights.size % 4 == 1 else -1
    return [
        lambda i=i, share=share, weight=weight: weight * read(i, share, i == middle)
        for i, share, weight in linear_reads(weights)
    ]


_TERMS = {"discrete": discrete_terms, "linear": _linear}
