"""A tap: its comparison, its weight, and the texels about a map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.shadow import compare


def test_a_soft_comparison_is_a_smoothstep_about_the_threshold():
    texel, threshold, softness = np.linspace(0, 2, 41), np.full(41, 1.0), 0.5
    along = np.clip((texel - threshold) / softness + 0.5, 0, 1)
    compared = jax.jit(compare.compare)
    found = compared(texel, threshold, softness)
    np.testing.assert_allclose(found, along**2 * (3 - 2 * along), atol=1e-14)
    hard = compared(texel, threshold, None)
    np.testing.assert_array_equal(hard, texel >= threshold)


@pytest.mark.parametrize("kernel", ["tent", "gaussian"])
@pytest.mark.parametrize("size", [3, 7])
def test_weights_fall_to_nothing_where_the_next_tap_takes_over(kernel, size):
    weight = jax.jit(lambda offset: compare.tap_weight(offset, size, kernel))
    offsets = np.linspace(0, size / 2, 20)
    after, before = np.asarray(weight(offsets)), np.asarray(weight(-offsets))
    assert after[-1] < 1e-15 and before[-1] < 1e-15
    assert (np.diff(after) < 0).all()
    np.testing.assert_allclose(before, after)


@pytest.mark.parametrize("missing", [np.nan, 0.0, -1.0])
def test_nothing_lies_nearer_outside_the_map_and_what_is_missing_is_infinitely_far(missing):
    shadow_map = np.array([[1.0, missing], [2.0, 3.0]])
    pad_map = jax.jit(compare.pad_map, static_argnums=(1, 2))
    padded = np.asarray(pad_map(shadow_map, 3, jnp.float64))
    known = np.zeros(padded.shape, bool)
    known[3:5, 3:5] = True
    np.testing.assert_array_equal(padded[known], [1.0, np.inf, 2.0, 3.0])
    assert np.isinf(padded[~known]).all()


def test_a_softness_everywhere_has_the_derivative_of_one():
    places = compare.Places(*(jnp.zeros((3, 4)) for _ in range(5)))
    total = lambda softness: jnp.sum(compare.per_place(softness, places) ** 2)
    np.testing.assert_allclose(jax.jit(jax.grad(total))(0.3), 2 * 0.3 * 12, rtol=1e-6)
    assert compare.per_place(None, places) is None
