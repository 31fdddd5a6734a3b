"""A loop over the pixels of a mask, however many there are: no capacity that could overflow.

The mask's bits are packed into words, whose set bits are counted and summed up. The n-th set
bit is then found by bisection, first among the words, then inside one. The loop processes
pixels in chunks and ends after the last: an empty mask costs no iteration.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from jaxfx._loops import fori_loop
from jaxfx._xla import stored


_WORD_BITS = 32
# Pixels per iteration. Larger chunks waste more work on the last one and need more memory;
# smaller ones pay the loop's overhead more often. Values do not depend on it.
_CHUNK = 2048


def fold(
    mask: Bool[Array, " pixel"],
    start: Any,
    fetch: Callable[[Int[Array, " chunk"]], Any],
    step: Callable[[Any, Int[Array, " chunk"], Any], Any],
) -> Any:
    """`start` after `carry = step(carry, pixels, fetch(pixels))` for all pixels of the mask.

    `pixels` are the flat indices of a chunk. In the last chunk, indices past the end of the
    image fill it up; `fetch` gets the last pixel in their place.

    The result of `fetch` is stored, or XLA would compute it again for each tap of a filter.
    """
    words = _pack(mask)
    ends = jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32))
    chunk = min(_CHUNK, mask.size)
    steps = (ends[-1] + chunk - 1) // chunk

    def load(k):
        rank = k * chunk + jnp.arange(chunk, dtype=jnp.int32)
        pixels = jnp.where(rank < ends[-1], _nth_set(words, ends, rank), mask.size)
        return pixels, fetch(jnp.minimum(pixels, mask.size - 1))

    def body(k, carry):
        pixels, fetched = stored(k < steps, load, k)
        return step(carry, pixels, fetched)

    return fori_loop(0, steps, body, start)


def _pack(bits: Bool[Array, " pixel"]) -> UInt32[Array, " word"]:
    """The mask's bits, 32 to a word, the first in the lowest place."""
    padded = jnp.pad(bits, (0, -bits.size % _WORD_BITS)).reshape(-1, _WORD_BITS)
    shifts = jnp.arange(_WORD_BITS, dtype=jnp.uint32)
    return jnp.sum(padded.astype(jnp.uint32) << shifts[None], axis=1, dtype=jnp.uint32)


def _nth_set(
    words: UInt32[Array, " word"], ends: Int[Array, " word"], rank: Int[Array, " chunk"]
) -> Int[Array, " chunk"]:
    """The index of the set bit with `rank` set bits before it; past the last, any index.

    `ends` counts the set bits up to the end of each word.
    """
    at = jnp.minimum(jnp.searchsorted(ends, rank, side="right"), words.size - 1)
    word = words[at]
    rank = rank - (ends[at] - jax.lax.population_count(word).astype(jnp.int32))
    bit = jnp.zeros_like(rank)
    for half in (16, 8, 4, 2, 1):
        low = word & jnp.uint32((1 << half) - 1)
        before = jax.lax.population_count(low).astype(jnp.int32)
        is_above = rank >= before
        rank = jnp.where(is_above, rank - before, rank)
        word = jnp.where(is_above, word >> half, word)
        bit = jnp.where(is_above, bit + half, bit)
    return at * _WORD_BITS + bit
