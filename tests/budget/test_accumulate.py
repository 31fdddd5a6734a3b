"""Plans for passes, against the mean over the lens in closed form."""

import inspect
import statistics

import numpy as np
import pytest
import scipy.special

from jaxfx import PinholeCamera, ThinLens, budget


CAMERA, LENS = PinholeCamera.from_fov(1.0, height=2, width=2), ThinLens(0.5, 2.0, 1.0)


def waves(rng):
    """Images that are waves over the lens, and their means: 2 J1(k r) / (k r)."""
    waves = rng.uniform(-40, 40, (2, 12))
    length = np.hypot(*waves) * 0.25
    mean = 2 * scipy.special.j1(length) / length
    picture = lambda eye: np.cos(np.asarray(eye.world_from_camera[:2, 3]) @ waves)
    return lambda eye: picture(eye)[:, None, None], mean[:, None, None]


@pytest.mark.full
def test_passes_are_within_the_error_that_their_variance_bounds():
    rng, slack = np.random.default_rng(0), []
    for _ in range(12):
        (render, mean), allowed = waves(rng), 10 ** rng.uniform(-1, -0.5)
        plan = budget.accumulate(render, CAMERA, LENS, max_error=allowed)
        picture = np.asarray(plan(render, CAMERA, LENS))
        slack.append(allowed / np.sqrt(np.mean((picture - mean) ** 2)))
        assert float(plan.predicted_error) <= allowed
        assert f"passes beyond {plan.recipe.samples}," in str(plan)
    assert min(slack) > 1
    assert statistics.median(slack) < 4


def test_a_picture_that_does_not_change_over_the_lens_takes_one_pass():
    plan = budget.accumulate(lambda eye: np.ones((2, 2, 1)), CAMERA, LENS, max_error=1e-3)
    assert plan.recipe.samples == 1


@pytest.mark.parametrize(
    ("error", "message"), [(0, "must be positive"), (-1, "must be a number")]
)
def test_an_error_of_nothing_is_refused(error, message):
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(budget.accumulate)(lambda eye: 0, CAMERA, LENS, max_error=error)
