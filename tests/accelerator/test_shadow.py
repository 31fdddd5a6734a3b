"""Shadows, as accelerators compute them."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.shadow import steps
from jaxfx import shadow
from tests.shadow.conftest import case, naive_pcf  # noqa: F401
from tests.shadow.test_edge import (  # noqa: F401
    test_depth_mask_is_pcf_in_every_form,
    test_derivatives_are_pcfs,
    test_nothing_to_filter_is_nothing_done,
    test_screen_mask_loses_an_edge_beyond_the_frame,
    test_screen_mask_misses_less_the_farther_edges_reach,
    test_screen_mask_with_enough_dilation_loses_no_wide_shadow,
    test_the_mask_by_depth_is_the_default_and_needs_no_dilation,
)


@pytest.mark.parametrize("edges", ["depth", "screen"])
def test_the_filter_is_taken_where_the_mask_asks_for_it(case, edges):  # noqa: F811
    """Every pixel by the naive loop; by the screen those that no edge reaches stay hard."""
    options = {"size": 7, "edges": edges, "bias": 0.02}
    options |= {"dilation": 2} if edges == "screen" else {}
    visible = shadow.edge_pcf(*case, **options)
    where = shadow.candidates(*case, **options).where
    full, hard = (naive_pcf(*case, size, bias=0.02) for size in (7, 1))
    np.testing.assert_allclose(visible, np.where(where, full, hard), atol=1e-12)


def test_no_bit_differs_from_the_filter():
    case = steps(3)  # noqa: F811
    exact = shadow.edge_pcf(*case, size=7, bias=0.02)
    np.testing.assert_array_equal(exact, shadow.pcf(*case, size=7, bias=0.02))


def test_what_the_mask_by_screen_leaves_out_has_no_derivative(case):  # noqa: F811
    """Forward and reverse against the derivative of the filter, by the mask."""
    shadow_map, receivers = case
    options = {"size": 3, "bias": 0.02, "softness": 0.3}
    screen = {"edges": "screen", "dilation": 1}
    where = shadow.candidates(*case, **options, **screen).where
    assert where.any() and not where.all()

    def of(function, z):
        return function(shadow_map, receivers._replace(z=z), **options)

    z = jnp.asarray(receivers.z)
    edge = ft.partial(of, ft.partial(shadow.edge_pcf, **screen))
    push = lambda function: jax.jvp(function, (z,), (jnp.ones_like(z),))[1]
    pull = lambda function: jax.vjp(function, z)[1](jnp.ones_like(z))[0]
    for way in (push, pull):
        expected = jnp.where(where, way(ft.partial(of, shadow.pcf)), 0)
        np.testing.assert_allclose(way(edge), expected, atol=1e-12)
