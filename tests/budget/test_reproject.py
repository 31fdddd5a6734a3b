"""Plans for reprojection."""

import inspect

import numpy as np
import pytest

from jaxfx import PinholeCamera, budget, reproject


SIZE = (10, 12)


def scene(rng):
    """A smooth wall, seen by two cameras that paint it nearly the same."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] / 10
    cameras, images, step = [], [], rng.uniform(0.01, 0.6)
    for place in (0.0, step):
        pose = np.eye(4)
        pose[0, 3] = place
        height, width = SIZE
        cameras.append(
            PinholeCamera.from_fov(1.0, height=height, width=width, world_from_camera=pose)
        )
        noise = 10 ** rng.uniform(-4, -1) * rng.normal(size=(*SIZE, 1))
        images.append(np.stack([0.5 + 0.3 * np.sin(2 * x + y)], axis=-1) + noise)
    return images, [np.full(SIZE, 4.0)] * 2, cameras, cameras[0]


@pytest.fixture(scope="module")
def plans(promised):
    return promised(scene, budget.reproject, reproject.blend, (-3.5, -0.5))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(60)


def test_some_plans_leave_a_source_out_and_some_a_few_tiles_of_it(plans):
    texts = [str(plan) for plan, _, _ in plans]
    assert any("all of sources 1, where others show next to the same" in text for text in texts)
    assert any("% of the rays, where" in text for text in texts)


def test_a_plan_knows_what_the_effect_knows(plans):
    """A source that alone sees some pixels is drawn there, however much error is allowed."""
    rng = np.random.default_rng(0)
    images, depths, cameras, _ = scene(rng)
    between = np.eye(4)
    between[0, 3] = 2.0
    height, width = SIZE
    target = PinholeCamera.from_fov(1.0, height=height, width=width, world_from_camera=between)
    data = (images, depths, cameras, target)
    known = reproject.blend(*data)[1]
    assert 0 < known.mean() < 1
    np.testing.assert_array_equal(budget.reproject(*data, max_error=10.0)(*data)[1], known)


def test_a_negative_error_is_refused():
    data = scene(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"`reproject\(max_error=...\)` must be a number"):
        inspect.unwrap(budget.reproject)(*data, max_error=-1)
