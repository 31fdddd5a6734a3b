"""Filtering only where it matters: which pixels, at what cost, and what is lost.

That masking by depth changes no bit of any size of filter is asked in `tests/stability`.
"""

import functools as ft
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.shadow import noise, plate, steps
from jaxfx import shadow
from jaxfx.shadow.edge import usual_dilation
from tests.helpers.forms import first

from .conftest import naive_pcf


@first(("kernel", "softness"), [("box", 0.2), ("tent", None), ("gaussian", 0.2)])
@pytest.mark.full
def test_depth_mask_is_pcf_in_every_form(kernel, softness):
    case = steps(3)
    options = {"size": 5, "kernel": kernel, "softness": softness, "bias": 0.02}
    visible = shadow.edge_pcf(*case, edges="depth", **options)
    np.testing.assert_allclose(visible, shadow.pcf(*case, **options), atol=1e-6)


@pytest.mark.parametrize("size", [3, 9])
def test_depth_mask_is_where_the_comparisons_differ(size):
    case = steps(4, np.float64)
    found = shadow.candidates(*case, size=size, edges="depth", bias=0.0)
    share = naive_pcf(
        case[0], case[1]._replace(z=np.where(np.isfinite(case[1].z), case[1].z, -1)), size
    )
    np.testing.assert_array_equal(found.where, (share > 0) & (share < 1))
    assert int(found.comparisons) == 2 * share.size + int(found.where.sum()) * size**2


# The screen mask's losses: a wall at depth 2 with a floor at 4, seen at some magnification.


@pytest.mark.parametrize("magnification", [0.25, 1.0, 8.0])
@pytest.mark.full
def test_screen_mask_with_enough_dilation_loses_no_wide_shadow(magnification):
    case = plate(magnification, 16 if magnification < 8 else 6)
    screen = shadow.edge_pcf(*case, size=7, edges="screen")
    np.testing.assert_array_equal(screen, shadow.pcf(*case, size=7))


def test_a_grazed_surface_does_not_make_the_dilation_the_picture():
    """A tenth of the rows lie along the light, where a filter covers ever more pixels."""
    shadow_map, receivers = plate(2.0, 16)
    grazed = receivers._replace(v=jnp.maximum(receivers.v, receivers.v[9:10]))
    found = [
        usual_dilation(jnp.asarray(shadow_map), each, *jnp.zeros(2), 7)
        for each in (receivers, grazed)
    ]
    assert found == [4 * 2 + 1] * 2


@pytest.mark.full
def test_screen_mask_misses_less_the_farther_edges_reach():
    case = plate(4.0, 4)
    full = shadow.pcf(*case, size=7)
    differing = [
        int(jnp.sum(shadow.edge_pcf(*case, size=7, edges="screen", dilation=d) != full))
        for d in (1, 16)
    ]
    assert differing == sorted(differing, reverse=True)
    assert differing[0] > 96
    assert differing[-1] == 0


@pytest.mark.full
def test_screen_mask_loses_a_shadow_between_pixels():
    """One texel wide, seen at a quarter: pixels step over it, so that it has no edge."""
    shadow_map, receivers = plate(0.25, 1, side=16)
    receivers = receivers._replace(u=receivers.u + 2.0)
    assert (shadow.hard(shadow_map, receivers) == 1).all()
    full = shadow.pcf(shadow_map, receivers, size=7)
    assert full.min() < 1
    screen = {"edges": "screen", "dilation": 3}
    assert (shadow.edge_pcf(shadow_map, receivers, size=7, **screen) == 1).all()
    exact = shadow.edge_pcf(shadow_map, receivers, size=7)
    np.testing.assert_array_equal(exact, full)


def test_screen_mask_loses_an_edge_beyond_the_frame():
    """The filter reaches the plate's ends, which the image does not show."""
    case = plate(8.0, 16)
    assert (shadow.edge_pcf(*case, size=7, edges="screen") == 0).all()
    assert shadow.pcf(*case, size=7).max() == pytest.approx(1 / 7)


def test_nothing_to_filter_is_nothing_done(case):
    lit = np.full_like(case[0], np.inf)
    for mask in ("screen", "depth"):
        found = shadow.candidates(lit, case[1], size=7, edges=mask)
        assert not found.where.any()
        assert found.comparisons == found.where.size * (2 if mask == "depth" else 1)
        assert (shadow.edge_pcf(lit, case[1], size=7, edges=mask) == 1).all()


def test_the_mask_by_depth_is_the_default_and_needs_no_dilation(case):
    options = {"size": 5, "kernel": "tent", "bias": 0.02}
    visible = jax.jit(ft.partial(shadow.edge_pcf, **options))(*case)
    np.testing.assert_allclose(visible, shadow.pcf(*case, **options), atol=1e-12)
    default, depth = (shadow.candidates(*case, size=5, **o) for o in ({}, {"edges": "depth"}))
    np.testing.assert_array_equal(default.where, depth.where)
    assert default.comparisons == depth.comparisons


@pytest.mark.full
def test_derivatives_are_pcfs():
    shadow_map, receivers = noise()
    options = {"size": 3, "kernel": "tent"}

    def loss(function, shadow_map, z, bias, softness):
        data = (shadow_map, receivers._replace(z=z))
        return jnp.sum(function(*data, bias=bias, softness=softness, **options) ** 2)

    at = (jnp.asarray(shadow_map), jnp.asarray(receivers.z), 0.05, 0.3)
    exact = ft.partial(shadow.edge_pcf, edges="depth")
    found, expected = (
        jax.jit(jax.grad(ft.partial(loss, function), argnums=(0, 1, 2, 3)))(*at)
        for function in (exact, shadow.pcf)
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_errors_name_their_argument(case):
    function = inspect.unwrap(shadow.edge_pcf)
    for name, options in {
        "size=...": {"size": 4},
        "edges=...": {"size": 3, "edges": "stencil"},
        "dilation=...": {"size": 3, "edges": "screen", "dilation": 0},
        "kernel=...": {"size": 3, "kernel": "disc"},
    }.items():
        with pytest.raises(ValueError) as caught:
            function(*case, **options)
        assert str(caught.value).startswith(f"`edge_pcf({name})`")
    with pytest.raises(ValueError, match=r"`edge_pcf\(dilation=...\)` must be given under"):
        jax.jit(ft.partial(function, size=3, edges="screen"))(*case)
    with pytest.raises(ValueError, match=r"`edge_pcf\(dilation=...\)` must be left out with"):
        function(*case, size=3, dilation=2)
