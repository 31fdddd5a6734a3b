"""Plans for shadows."""

import functools
import inspect

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import budget, shadow
from jaxfx.budget.shadow import Picked


def scene(rng):
    """Cards over a floor, which receivers see from anywhere."""
    y, x = np.mgrid[:24, :24] + 0.5
    shadow_map = np.full((24, 24), 5.0)
    for _ in range(rng.integers(0, 4)):
        cx, cy, side = *rng.uniform(0, 24, 2), rng.uniform(0.5, 7)
        shadow_map[(abs(x - cx) < side) & (abs(y - cy) < side)] = rng.uniform(1, 4)
    u, v = (
        rng.uniform(2, 22) + rng.uniform(0.05, 0.8) * (side[:16, :16] - 8) for side in (x, y)
    )
    return shadow_map, shadow.Receivers(*map(np.asarray, (u, v, 5 + 0 * u, 0 * u)))


@pytest.fixture(scope="module")
def plans(promised):
    how = {"size": 5, "bias": 0.1}
    plan, full = (functools.partial(call, **how) for call in (budget.shadow, shadow.pcf))
    return promised(scene, plan, full, (-2, -0.5))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(0.1)


def test_plans_differ_with_scenes_and_say_why(plans):
    texts = [str(plan) for plan, _, _ in plans]
    for part in (
        "it can't matter in more than",
        "% of the pixels, held fixed",
        "outside of the",
        "a filter larger than 3 x 3",
    ):
        assert any(part in text for text in texts), part


def test_picked_pixels_are_filtered_and_no_others():
    (shadow_map, _), how = scene(np.random.default_rng(4)), {"bias": 0.1}
    shadow_map[:, :12] = 2.0
    y, x = np.mgrid[4:20, 4:20] + 0.5
    data = shadow_map, shadow.Receivers(x, y, 5 + 0 * x, 0 * x)
    pixels = np.random.default_rng(5).permutation(256)[:100]
    full, hard = shadow.pcf(*data, size=5, **how), shadow.hard(*data, **how)
    some = np.isin(np.arange(256), pixels).reshape(16, 16)
    assert (np.asarray(full) != hard)[some].any() and (np.asarray(full) != hard)[~some].any()
    plan = Picked(jnp.asarray(0.1), jnp.asarray(0.0), 5, jnp.append(pixels, 256))
    np.testing.assert_array_equal(plan(*data), np.where(some, full, hard))


def test_a_negative_error_is_refused():
    data = scene(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"`shadow\(max_error=...\)` must be a number"):
        inspect.unwrap(budget.shadow)(*data, size=3, max_error=-1)
