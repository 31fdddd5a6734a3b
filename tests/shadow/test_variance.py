"""Variance shadow maps."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import shadow
from tests.helpers.quick import check_slopes


def at(u, v, z):
    return shadow.Receivers(*(jnp.full((1, 1), float(each)) for each in (u, v, z, 0.0)))


def test_two_depths_meet_the_bound():
    """Where the farther depth is the receiver's the bound is the share that is lit."""
    shadow_map = np.full((9, 9), 4.0)
    shadow_map[:, :4] = 1.0
    for u in (3.5, 4.5, 5.5):
        found = shadow.variance(shadow_map, at(u, 4.5, 4.0), size=5, bias=0.0)[0, 0]
        share = shadow.pcf(shadow_map, at(u, 4.5, 4.0), size=5)[0, 0]
        assert float(found) == pytest.approx(float(share), abs=1e-12)


def test_it_is_chebyshevs_bound():
    shadow_map = np.random.default_rng(0).uniform(1, 3, (9, 9))
    window = shadow_map[2:7, 3:8]
    for z in (1.5, 2.2, 2.9):
        gap = z - 0.1 - window.mean()
        bound = window.var() / (window.var() + gap**2) if gap > 0 else 1
        found = shadow.variance(shadow_map, at(5.5, 4.5, z), size=5, bias=0.1)[0, 0]
        assert float(found) == pytest.approx(bound, abs=1e-12)


def test_light_leaks_below_two_occluders():
    """Chebyshev's bound of depths 1 and 3 under a receiver at 4: far above the true 0."""
    shadow_map = np.where(np.arange(9) % 2, 1.0, 3.0) * np.ones((9, 1))
    assert float(shadow.variance(shadow_map, at(4.5, 4.5, 4.0), size=5)[0, 0]) > 0.15
    assert shadow.pcf(shadow_map, at(4.5, 4.5, 4.0), size=5)[0, 0] == 0


def naive_warped(window, z, exponents, least=0.0, depths=None):
    """The smaller of Chebyshev's bounds of two warped depths, of a window of texels."""
    depths = [*np.ravel(window if depths is None else depths), z]
    near, scale = min(depths), max(depths) - min(depths)
    bounds = [1.0]
    for sign, c in zip((1, -1), exponents, strict=True):
        warp = lambda depth, sign=sign, c=c: (
            sign * np.exp(sign * c * ((depth - near) / scale - 0.5))
        )
        mean, variance = warp(window).mean(), warp(window).var()
        variance = max(variance, least * (c * warp(z) / scale) ** 2)
        gap = warp(z) - mean
        bounds.append(variance / (variance + gap**2) if gap > 0 else 1)
    return min(bounds)


@pytest.mark.parametrize("least", [0.0, 0.01])
def test_it_is_the_smaller_bound_of_two_warped_depths(least):
    shadow_map = np.random.default_rng(0).uniform(1, 3, (9, 9))
    options = {"size": 5, "bias": 0.1, "min_variance": least}
    for z in (1.5, 2.2, 2.9):
        for exponents in ((3.0, 2.0), (40.0, 5.0)):
            window, t = shadow_map[2:7, 3:8], z - 0.1
            expected = naive_warped(window, t, exponents, least, shadow_map)
            found = shadow.variance(
                shadow_map, at(5.5, 4.5, z), exponents=np.array(exponents), **options
            )
            assert float(found[0, 0]) == pytest.approx(expected, rel=1e-9)


def test_a_warp_closes_the_leak_below_two_occluders():
    shadow_map = np.where(np.arange(9) % 2, 1.0, 3.0) * np.ones((9, 1))
    found = shadow.variance(shadow_map, at(4.5, 4.5, 4.0), size=5, exponents=(80, 10))
    assert float(found[0, 0]) < 1e-12


def test_the_largest_exponents_of_float32_do_not_overflow():
    """The farthest and the nearest depth of the range, in the widest filter of the map."""
    shadow_map = np.where(np.arange(33) % 2, 1.0, 9.0) * np.ones((33, 1))
    shadow_map, z = np.float32(shadow_map), jnp.asarray([[9.0, 1.0]], jnp.float32)
    middle = jnp.full_like(z, 16.5)
    seen = shadow.Receivers(middle, middle, z, 0 * z)
    run = lambda exponents: shadow.variance(shadow_map, seen, size=31, exponents=exponents)
    found, slopes = run((80, 80)), jax.jacrev(run)(jnp.asarray([80.0, 80.0], jnp.float32))
    share = shadow.pcf(shadow_map, seen, size=31)
    np.testing.assert_allclose(found, share, atol=1e-5)
    assert np.isfinite(slopes).all()
    beyond = jax.jit(run)(jnp.asarray([500.0, 500.0], jnp.float32))
    np.testing.assert_array_equal(beyond, found)


def test_lit_whatever_the_map_says():
    wall, warped = np.ones((4, 5)), {"exponents": (80, 10)}
    for u, v, z in [(-9, 2, 5), (99, 2, 5), (2, 2, -1), (np.nan, 2, 5), (2, 2, np.nan)]:
        for options in ({}, warped):
            assert shadow.variance(wall, at(u, v, z), size=3, **options)[0, 0] == 1
    assert shadow.variance(np.full((4, 5), np.inf), at(2, 2, 5), size=3)[0, 0] == 1
    assert shadow.variance(wall, at(2.5, 2, 5), size=1)[0, 0] == pytest.approx(0, abs=1e-12)


@pytest.mark.full
def test_reverse_mode_matches_differences(case):
    shadow_map, receivers = np.minimum(case[0], 4.0), case[1]
    receivers = jax.tree.map(jnp.asarray, receivers)

    def loss(u, bias):
        data = (shadow_map, receivers._replace(u=u))
        return jnp.sum(shadow.variance(*data, size=3, bias=bias) ** 2)

    arguments = (receivers.u, jnp.asarray(0.1))
    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    slopes, step = both(*arguments)[1], 1e-6
    ahead, behind = (both(*(x + s for x in arguments))[0] for s in (step, -step))
    expected = float(ahead - behind) / (2 * step)
    assert float(slopes[0].sum() + slopes[1]) == pytest.approx(expected, rel=1e-5)


def test_both_modes_match_differences_with_a_warp(case):
    """In depth, bias and exponents."""
    shadow_map, receivers = np.minimum(case[0], 4.0), case[1]

    def loss(z, bias, exponents):
        seen = receivers._replace(z=z)
        found = shadow.variance(shadow_map, seen, size=3, bias=bias, exponents=exponents)
        return jnp.sum(found**2)

    at = (jnp.asarray(receivers.z), jnp.asarray(0.1), jnp.asarray([6.0, 3.0]))
    check_slopes(loss, at)


def test_errors_name_their_argument(case):
    function = inspect.unwrap(shadow.variance)
    for name, options in (
        ("size", {"size": 2}),
        ("min_variance", {"min_variance": -1.0}),
        ("exponents", {"exponents": [8.0, 1000.0]}),
        ("exponents", {"exponents": [0.0, 8.0]}),
        ("exponents", {"exponents": 8.0}),
    ):
        with pytest.raises(ValueError) as caught:
            function(*case, **({"size": 3} | options))
        assert str(caught.value).startswith(f"`variance({name}=...)`")
