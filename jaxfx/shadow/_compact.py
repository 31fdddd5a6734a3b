"""Work on some pixels of many: as many as there are, without a capacity that could overflow.

The pixels' bits are packed into words, whose counts are summed; then the place of the n-th set
bit is found by halving, first among the words, then inside one. A loop does the pixels chunk by
chunk, and ends with the last: where no bit is set, nothing is done.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32


_BITS = 32
_CHUNK = 2048


def fold(
    where: Bool[Array, " pixel"],
    start: Any,
    fetch: Callable[[Int[Array, " chunk"]], Any],
    step: Callable[[Any, Int[Array, " chunk"], Any], Any],
) -> Any:
    """`start` after `step(carry, pixels, fetch(pixels))` for chunk by chunk of what is `where`.

    In the last chunk pixels past the end stand for none; they are fetched as the last one.
    What `fetch` gives comes out of a branch, which lays it out in memory: else XLA would fetch
    it anew for each tap of a filter.
    """
    words = _pack(where)
    ends = jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32))
    chunk = min(_CHUNK, where.size)
    steps = (ends[-1] + chunk - 1) // chunk

    def load(k):
        rank = k * chunk + jnp.arange(chunk, dtype=jnp.int32)
        pixels = jnp.where(rank < ends[-1], _nth_set(words, ends, rank), where.size)
        return pixels, fetch(jnp.minimum(pixels, where.size - 1))

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(load, steps))

    def body(k, carry):
        pixels, fetched = jax.lax.cond(k < steps, load, lambda _: nothing, k)
        return step(carry, pixels, fetched)

    return jax.lax.fori_loop(0, steps, body, start)


def _pack(bits: Bool[Array, " pixel"]) -> UInt32[Array, " word"]:
    padded = jnp.pad(bits, (0, -bits.size % _BITS)).reshape(-1, _BITS)
    shifts = jnp.arange(_BITS, dtype=jnp.uint32)
    return jnp.sum(padded.astype(jnp.uint32) << shifts[None], axis=1, dtype=jnp.uint32)


def _nth_set(
    words: UInt32[Array, " word"], ends: Int[Array, " word"], rank: Int[Array, " chunk"]
) -> Int[Array, " chunk"]:
    """The index of the bit that so many set ones stand before; anything beyond the last."""
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
    return at * _BITS + bit
