"""Plans for reprojection."""

import inspect

import numpy as np
import pytest

from jaxfx import PinholeCamera, budget, reproject


SIZE = (10, 12)


def scene(rng, step):
    """A smooth wall seen by three cameras, `step` apart, which paint it nearly the same."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] / 10
    cameras, images = [], []
    for place in (0.0, -step, step):
        pose = np.eye(4)
        pose[0, 3] = place
        height, width = SIZE
        cameras.append(
            PinholeCamera.from_fov(1.0, height=height, width=width, world_from_camera=pose)
        )
        noise = 10 ** rng.uniform(-4, -1) * rng.normal(size=(*SIZE, 1))
        images.append(np.stack([0.5 + 0.3 * np.sin(2 * x + y)], axis=-1) + noise)
    return images, [np.full(SIZE, 4.0)] * 3, cameras, cameras[0]


@pytest.fixture(scope="module")
def plans():
    rng, found = np.random.default_rng(0), []
    for _ in range(20):
        data, max_error = scene(rng, rng.uniform(0.01, 0.6)), 10 ** rng.uniform(-3.5, -0.5)
        plan = budget.reproject(*data, max_error=max_error)
        image, alpha = plan(*data)
        assert alpha.shape == SIZE
        difference = image - reproject.blend(*data)[0]
        found.append((plan, max_error, float(np.sqrt(np.mean(difference**2)))))
    return found


def test_no_plan_exceeds_its_error(plans):
    for plan, max_error, error in plans:
        assert error <= max_error
        assert error == pytest.approx(float(plan.predicted_error), rel=1e-6, abs=1e-12)


def test_some_plans_take_one_source_and_some_take_all(plans):
    counts = {len(plan.recipe.chosen) for plan, _, _ in plans}
    assert {1, 3} <= counts
    assert any("sources 1, 2" in str(plan) for plan, _, _ in plans)


def test_a_negative_error_is_refused():
    data = scene(np.random.default_rng(0), 0.1)
    with pytest.raises(ValueError, match=r"`reproject\(max_error=...\)` must be a number"):
        inspect.unwrap(budget.reproject)(*data, max_error=-1)
