"""The traversal alone: its packed state, and a bound on its steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.reproject import run
from jaxfx.reproject._walk import level_of, pack, unpack
from tests.cases.reproject import awkward_rays, field


pytestmark = pytest.mark.usefixtures("quick")


def test_a_state_is_one_integer_that_keeps_all_five():
    rng = np.random.default_rng(0)
    most = (2**13, 2**13, 16, 2, 2)
    parts = [jnp.asarray(rng.integers(0, size, 500), jnp.int32) for size in most]
    state = pack(*parts)
    assert state.dtype == jnp.uint32
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
