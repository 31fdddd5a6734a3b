"""The traversal alone: its packed state, and a bound on its steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.reproject import run
from jaxfx.reproject._crossings import coordinates
from jaxfx.reproject._searches import first_crossing
from jaxfx.reproject._traversal import level_of, pack, unpack
from tests.cases.reproject import awkward_rays, field


def test_a_state_is_one_integer_that_keeps_all_five():
    rng = np.random.default_rng(0)
    most = (2**13, 2**13, 16, 2, 2)
    parts = [jnp.asarray(rng.integers(0, size, 500), jnp.int32) for size in most]
    state = pack(*parts)
    assert state.dtype == jnp.int32
    for part, kept in zip(parts, unpack(state), strict=True):
        np.testing.assert_array_equal(kept, part)
    np.testing.assert_array_equal(level_of(state), parts[2])


def test_a_bound_on_steps_is_kept_and_said():
    rng = np.random.default_rng(1)
    depth = field((64, 64), rng)
    origin, direction = awkward_rays((64, 64), rng)
    free = run(depth, origin, direction)
    bound = int(np.median(free.steps))
    hit = run(depth, origin, direction, max_steps=bound)
    np.testing.assert_array_equal(hit.exhausted, free.steps > bound)
    assert hit.exhausted.any() and not (hit.mask & hit.exhausted).any()
    np.testing.assert_array_equal(hit.steps, np.minimum(free.steps, bound))
    within = ~np.asarray(hit.exhausted)
    np.testing.assert_array_equal(hit.mask[within], free.mask[within])


@pytest.mark.parametrize("method", ["pyramid", "linear", "relief"])
@pytest.mark.full
def test_rays_from_their_end_meet_what_they_meet_from_their_start(method):
    """Those that run away are given by where they are at time 0, and begin at -1. (Where the
    descent begins, on the border of the image, rounding decides.)"""
    rng = np.random.default_rng(2)
    depth = jnp.asarray(field((24, 31), rng))
    depth = jnp.where(depth > 0, depth, jnp.inf)
    begin, along = (jnp.asarray(v) for v in awkward_rays((24, 31), rng))
    half = len(begin) // 2  # the other half lies on borders, where rounding decides
    begin, along = begin[:half], along[:half]
    runs_away = along[:, 2:] > 0
    origin = jnp.where(runs_away, begin + along, begin)
    origin, begin, along = map(coordinates, (origin, begin, along))
    expected = first_crossing(depth, begin, along, method, None)
    found = first_crossing(depth, origin, along, method, None, origin_at_end=True)
    np.testing.assert_array_equal(found.mask, expected.mask)
    for name in ("x", "y", "face", "steps"):
        both = (np.asarray(getattr(each, name))[expected.mask] for each in (found, expected))
        np.testing.assert_array_equal(*both, name)
    later = jnp.where(expected.mask, expected.time - runs_away[:, 0].astype(float), 0)
    np.testing.assert_allclose(found.time, later, atol=1e-12)
    assert expected.mask.sum() > 30 and not found.time[~found.mask].any()


@pytest.mark.full
def test_a_ray_that_comes_in_at_an_edge_is_inside_whatever_rounding_says():
    """Rays from the right edge of the image to where they end, in it, in float32."""
    rng = np.random.default_rng(3)
    end = rng.uniform((0, 0, 0), (96, 96, 1), (4000, 3)).astype(np.float32)
    edge = np.stack([np.full(4000, 96), *rng.uniform((0, -1), (96, 0), (4000, 2)).T], axis=-1)
    along = end - edge.astype(np.float32)
    wall = jnp.full((96, 96), -1, jnp.float32)
    end, along = (coordinates(jnp.asarray(x)) for x in (end, along))
    found = first_crossing(wall, end, along, "pyramid", None, origin_at_end=True)
    assert found.mask.all()
    assert (np.asarray(found.y) == np.floor(edge[:, 1])).mean() > 0.99
