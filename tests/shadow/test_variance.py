"""Variance shadow maps."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import shadow


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


def test_lit_whatever_the_map_says():
    wall = np.ones((4, 5))
    for u, v, z in [(-9, 2, 5), (99, 2, 5), (2, 2, -1), (np.nan, 2, 5), (2, 2, np.nan)]:
        assert shadow.variance(wall, at(u, v, z), size=3)[0, 0] == 1
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


def test_errors_name_their_argument(case):
    function = inspect.unwrap(shadow.variance)
    for name, options in (("size", {"size": 2}), ("min_variance", {"min_variance": -1.0})):
        with pytest.raises(ValueError) as caught:
            function(*case, **({"size": 3} | options))
        assert str(caught.value).startswith(f"`variance({name}=...)`")
