"""Plans for lights."""

import inspect

import numpy as np
import pytest

from jaxfx import GBuffer, PinholeCamera, PointLight, budget, relight


SIZE, COUNT = (8, 10), 8


def scene(rng):
    """A wall that faces the camera, and lights of which most are dim."""
    image = lambda: rng.uniform(0.1, 1, (*SIZE, 3))
    normal = np.broadcast_to([0.0, 0.0, -1.0], (*SIZE, 3))
    depth, rough = rng.uniform(3, 4, SIZE), rng.uniform(0.3, 0.9, SIZE)
    reflectances = image(), image(), image()
    cache = GBuffer(image(), np.zeros(SIZE, int), *reflectances, normal, depth, rough)
    camera = PinholeCamera.from_fov(1.0, height=SIZE[0], width=SIZE[1])
    lights = [
        PointLight(rng.uniform(-2, 2, 3), 10 ** rng.uniform(-3, 1) * rng.uniform(0.2, 1, 3))
        for _ in range(COUNT)
    ]
    return cache, camera, lights


@pytest.fixture(scope="module")
def plans(promised):
    return promised(scene, budget.relight, relight.render, (-3, -1))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(150)


def test_a_plan_names_the_lights_that_it_drops():
    cache, camera, _ = scene(np.random.default_rng(1))
    place = [0.0, 0.0, 0.0]
    lights = [PointLight(place, [b, b, b]) for b in (3.0, 1e-4, 2.0, 0.0)]
    plan = budget.relight(cache, camera, lights, max_error=1e-3)
    assert plan.recipe.kept == (0, 2)
    assert "light 1, for it brings" in str(plan)
    assert "light 3, for it brings 0" in str(plan)


def test_a_negative_error_is_refused():
    with pytest.raises(ValueError, match=r"`relight\(max_error=...\)` must be a number"):
        inspect.unwrap(budget.relight)(*scene(np.random.default_rng(0)), max_error=-1)
