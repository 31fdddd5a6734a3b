"""The traversal alone: its packed state, and what a bound on its steps cuts short."""

import jax.numpy as jnp
import numpy as np
import pytest
from reproject_cases import posts, slanted_rays

from jaxfx.reproject._walk import level_of, pack, unpack, walk


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


def test_a_bound_cuts_the_rays_that_need_more_and_no_others():
    depth, (origin, direction) = jnp.asarray(posts(48)), slanted_rays(48, 16)
    origin, direction = (jnp.asarray(x).reshape(-1, 3) for x in (origin, direction))
    free = walk(depth, origin, direction, None)
    assert not free.exhausted.any()
    for bound in (1, 12):
        found, done = walk(depth, origin, direction, bound), np.asarray(free.steps) <= bound
        np.testing.assert_array_equal(found.exhausted, ~done)
        np.testing.assert_array_equal(found.mask, free.mask & done)
        np.testing.assert_array_equal(np.where(done, found.time - free.time, 0), 0)
        np.testing.assert_array_equal(found.steps, np.minimum(free.steps, bound))
