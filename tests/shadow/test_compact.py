"""The loop over the pixels that are left."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx.shadow import _compact


def test_comparisons_are_counted_where_they_are_made():
    """The loop visits every candidate once, and nothing else; none for a map without edges."""
    rng = np.random.default_rng(0)

    @jax.jit
    def visit(where):
        def add(total, pixels, fetched):
            return total.at[pixels].add(1.0 + fetched.astype(float), mode="drop")

        return _compact.fold(where, jnp.zeros(9001), lambda pixels: pixels, add)

    for share in (0.0, 0.001, 0.04, 0.5, 1.0):
        where = jnp.asarray(rng.uniform(size=9001) < share)
        visits = visit(where)
        np.testing.assert_array_equal(visits, jnp.where(where, jnp.arange(1.0, 9002.0), 0))


def test_chunks_run_as_many_as_there_are_candidates():
    calls = []

    def count(total, pixels, _):
        jax.debug.callback(lambda: calls.append(1))
        return total + jnp.sum(pixels < size)

    size = 3 * _compact._CHUNK
    for count_set, rounds in ((0, 0), (1, 1), (_compact._CHUNK, 1), (_compact._CHUNK + 1, 2)):
        calls.clear()
        where = jnp.arange(size) < count_set
        assert _compact.fold(where, 0, lambda pixels: pixels, count) == count_set
        jax.effects_barrier()
        assert len(calls) == rounds
