"""Comparison with a shadow map: alone, before filtering and after it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.shadow import noise
from jaxfx import shadow
from tests.helpers.forms import first

from .conftest import naive_pcf


KERNELS = ("box", "tent", "gaussian")


def one(u, v, z, slope=0.0):
    return shadow.Receivers(*(jnp.full((1, 1), float(value)) for value in (u, v, z, slope)))


@pytest.mark.parametrize("size", [1, 3, 7, 11, 31])
def test_pcf_is_the_naive_loop(case, size):
    visible = shadow.pcf(*case, size=size, bias=0.05, slope_bias=0.5)
    np.testing.assert_allclose(visible, naive_pcf(*case, size, 0.05, 0.5), atol=1e-15)


def test_hard_is_pcf_of_one_texel(case):
    visible = shadow.hard(*case, bias=0.05, slope_bias=0.5)
    np.testing.assert_array_equal(visible, naive_pcf(*case, 1, 0.05, 0.5))
    assert 0 < np.mean(visible) < 1


def test_the_example_of_the_source():
    """Means of 22.9 and 49.8 say shadow; comparing first says a share."""
    near = np.array([[1.2, 50.0, 1.1], [1.3, 50.1, 50.2], [1.0, 1.4, 49.8]])
    receiver = one(1.5, 1.5, 49.8)
    assert near.mean() == pytest.approx(22.9, abs=0.05)
    assert shadow.prefiltered(near, receiver, size=3)[0, 0] == 0
    assert shadow.pcf(near, receiver, size=3)[0, 0] == pytest.approx(4 / 9)


def test_prefiltered_is_the_mean_compared_once():
    shadow_map, receivers = noise(map_shape=(20, 20))
    shadow_map = np.where(np.isinf(shadow_map), 2.0, shadow_map)
    visible = np.asarray(shadow.prefiltered(shadow_map, receivers, size=5))
    padded = np.pad(shadow_map, 10, constant_values=np.inf)
    for j, i in np.ndindex(*visible.shape):
        u, v, z, _ = (field[j, i] for field in receivers)
        x, y = int(np.floor(u)) + 10, int(np.floor(v)) + 10
        mean = padded[y - 2 : y + 3, x - 2 : x + 3].mean()
        assert visible[j, i] == (z <= 0 or mean >= z)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("softness", [None, 0.3])
def test_what_is_lit_whatever_the_map_says(kernel, softness):
    options = {"size": 3, "kernel": kernel, "softness": softness}
    wall = np.ones((4, 5))
    for u, v, z in [(-9, 2, 5), (99, 2, 5), (2, -9, 5), (2, 99, 5), (2, 2, -1), (2, 2, 0)]:
        assert shadow.pcf(wall, one(u, v, z), **options)[0, 0] == 1
    for wrong in [one(np.nan, 2, 5), one(2, np.inf, 5), one(2, 2, np.nan), one(2, 2, np.inf)]:
        assert shadow.pcf(wall, wrong, **options)[0, 0] == 1
    assert shadow.pcf(np.full((4, 5), np.inf), one(2, 2, 5), **options)[0, 0] == 1
    assert shadow.pcf(wall, one(2, 2, 5), **options)[0, 0] == pytest.approx(0, abs=1e-15)


def test_equal_depth_is_lit():
    wall = np.full((3, 3), 2.0)
    assert shadow.hard(wall, one(1, 1, 2.0), bias=0.0)[0, 0] == 1
    assert shadow.hard(wall, one(1, 1, np.nextafter(2.0, 3)), bias=0.0)[0, 0] == 0
    assert shadow.hard(wall, one(1, 1, 2.5), bias=0.5)[0, 0] == 1
    assert shadow.hard(wall, one(1, 1, 2.5, slope=0.25), slope_bias=2.0)[0, 0] == 1


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_bad_texel_or_receiver_spoils_only_its_own(case, kernel):
    shadow_map, receivers = case
    options = {"size": 5, "kernel": kernel, "softness": 0.2}
    clean = np.asarray(shadow.pcf(*case, **options))
    broken = shadow_map.copy()
    broken[6, 8] = np.nan
    changed = np.asarray(shadow.pcf(broken, receivers, **options)) != clean
    u, v = np.floor(receivers.u), np.floor(receivers.v)
    reached = (abs(u - 8) <= 2) & (abs(v - 6) <= 2)
    assert changed.any()
    assert not changed[~reached].any()
    z = receivers.z.copy()
    z[4, 4] = np.nan
    again = np.array(shadow.pcf(shadow_map, receivers._replace(z=z), **options))
    assert again[4, 4] == pytest.approx(1, abs=1e-15)
    again[4, 4] = clean[4, 4]
    np.testing.assert_array_equal(again, clean)


@pytest.mark.parametrize("map_shape", [(1, 1), (1, 9), (3, 2)])
def test_a_map_smaller_than_the_filter(map_shape):
    case = noise(map_shape=map_shape)
    np.testing.assert_allclose(
        shadow.pcf(*case, size=7, bias=0.0), naive_pcf(*case, 7), atol=1e-15
    )


@pytest.mark.parametrize("kernel", KERNELS)
def test_softness_tends_to_the_hard_picture(case, kernel):
    sharp = shadow.pcf(*case, size=5, kernel=kernel)
    gaps = [
        np.abs(shadow.pcf(*case, size=5, kernel=kernel, softness=width) - sharp).max()
        for width in (1.0, 0.1, 1e-2, 1e-6)
    ]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[0] > 0.05
    assert gaps[-1] < 1e-12


@pytest.mark.parametrize("kernel", ["tent", "gaussian"])
def test_weights_that_follow_the_receiver_are_continuous(kernel):
    """Across a texel's border the box jumps, the others do not."""
    shadow_map = noise(seed=2)[0]

    def at(u, kernel):
        return float(shadow.pcf(shadow_map, one(u, 7.3, 2.0), size=5, kernel=kernel)[0, 0])

    jumps = [abs(at(x - 1e-9, kernel) - at(x + 1e-9, kernel)) for x in range(3, 14)]
    assert max(jumps) < 1e-8
    assert max(abs(at(x - 1e-9, "box") - at(x + 1e-9, "box")) for x in range(3, 14)) > 0.01


@first("kernel", KERNELS)
def test_gradients_of_soft_forms(case, kernel):
    shadow_map, receivers = case
    weight = np.random.default_rng(5).normal(size=receivers.z.shape)

    def loss(shadow_map, receivers, bias, slope_bias, softness):
        options = {"bias": bias, "slope_bias": slope_bias, "softness": softness}
        return jnp.sum(
            weight * shadow.pcf(shadow_map, receivers, size=3, kernel=kernel, **options)
        )

    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3, 4)))
    for softness in (0.03, 1.0):
        at = jax.tree.map(jnp.asarray, (shadow_map, receivers, 0.05, 0.4, softness))
        check_along_random_directions(lambda *at: both(*at)[0], at, both(*at)[1])


def check_along_random_directions(loss, at, slopes):
    rng = np.random.default_rng(6)
    for index, (value, slope) in enumerate(zip(at, slopes, strict=True)):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
        along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), value)
        moved = [
            jax.tree.map(lambda x, d, s=s: jnp.where(jnp.isinf(x), x, x + s * d), value, along)
            for s in (1e-7, -1e-7)
        ]
        ahead, behind = (loss(*at[:index], move, *at[index + 1 :]) for move in moved)
        products = jax.tree.map(jnp.vdot, slope, along)
        expected = float(ahead - behind) / 2e-7
        assert abs(expected) > 1e-3
        assert float(sum(jax.tree.leaves(products))) == pytest.approx(expected, rel=1e-4)


def test_hard_forms_have_zero_gradients(case):
    for function in (
        shadow.hard,
        lambda *data, **biases: shadow.prefiltered(*data, size=3, **biases),
        lambda *data, **biases: shadow.pcf(*data, size=3, **biases),
    ):

        def loss(shadow_map, receivers, bias, function=function):
            return jnp.sum(function(shadow_map, receivers, bias=bias, slope_bias=bias))

        arguments = jax.tree.map(jnp.asarray, (*case, 0.1))
        for leaf in jax.tree.leaves(jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*arguments)):
            np.testing.assert_array_equal(leaf, 0)
