"""Plans for lights."""

import importlib
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    PinholeCamera,
    PointLight,
    SpotLight,
    budget,
    relight,
)
from jaxfx.budget._lights_by_tile import Tiled
from jaxfx.budget._merged_lights import Merged, Place, nearest
from jaxfx.budget._tiles import blocks


SIZE, COUNT = (8, 16), 4


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
    """Of images just large enough that merged lights are tried in some of their pixels."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"_EVERY": 4, "_MANY": 128}.items():
            patch.setattr(importlib.import_module("jaxfx.budget.relight"), name, value)
        return promised(scene, budget.relight, relight.render, (-3, -1))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(0.6)


def test_a_plan_names_the_lights_that_it_drops():
    cache, camera, _ = scene(np.random.default_rng(1))
    place = [0.0, 0.0, 0.0]
    lights = [PointLight(place, [b, b, b]) for b in (3.0, 1e-4, 2.0, 0.0)]
    assert "lights 1, 3, " in str(budget.relight(cache, camera, lights, max_error=1e-3))


@pytest.mark.full
def test_lights_are_computed_where_they_are_needed():
    """Against the image of each light times the pixels that it is drawn in."""
    rng = np.random.default_rng(2)
    cache, camera, lights = scene(rng)
    visibilities = [rng.uniform(0, 1, SIZE), None, rng.uniform(0, 1, SIZE), None]
    where = rng.uniform(0, 1, (COUNT, *SIZE)) < 0.5
    where[0] = True
    parts = where.reshape(COUNT, -1) & (np.arange(COUNT) > 0)[:, None]
    plan = Tiled((0,), (0, 2), blocks(parts, lights))
    alone = [
        relight.shade(cache, camera, light, visible) * mask.astype(float)[..., None]
        for light, visible, mask in zip(lights, visibilities, where, strict=True)
    ]
    picture = plan(cache, camera, lights, visibilities)
    np.testing.assert_allclose(picture, sum(alone), rtol=1e-9)
    # The sum is linear in the lights' colours, and so is its own derivative along them.
    scaled = lambda s: [
        eqx.tree_at(lambda light: light.color, light, s * light.color) for light in lights
    ]
    total = lambda s: jnp.sum(plan(cache, camera, scaled(s), visibilities))
    np.testing.assert_allclose(jax.grad(total)(1.0), picture.sum(), rtol=1e-9)


@pytest.mark.full
def test_a_light_that_reaches_a_corner_is_computed_there_alone():
    size = (24, 32)
    flat = lambda *value: np.broadcast_to(np.array(value, float), (*size, len(value)))
    gray, normal = flat(0.5, 0.5, 0.5), flat(0, 0, -1)
    plane = lambda value: np.full(size, value)
    cache = GBuffer(
        gray, plane(0).astype(int), gray, gray, gray, normal, plane(4.0), plane(0.5)
    )
    camera = PinholeCamera.from_fov(1.0, height=24, width=32)
    corner = camera.unproject(jnp.array([2.0, 2.0]), jnp.array(3.9))
    lights = [DirectionalLight([0, 0, 1], [1, 1, 1]), PointLight(corner, [0.01, 0.01, 0.01])]
    plan = budget.relight(cache, camera, lights, max_error=2e-3)
    assert "light 1 in 92% of their tiles" in str(plan)


@pytest.mark.full
def test_shadows_that_take_nothing_away_need_no_map():
    rng = np.random.default_rng(5)
    cache, camera, lights = scene(rng)
    visibilities = [np.ones(SIZE), rng.uniform(0, 1, SIZE), np.ones(SIZE), None]
    full = relight.start(cache, camera, lights, visibilities=visibilities).image
    plan = budget.relight(cache, camera, lights, visibilities=visibilities, max_error=1e-4)
    assert "shadows 0, 2, 0 at most" in str(plan)
    without = plan(cache, camera, lights, [None, visibilities[1], None, None])
    assert np.sqrt(np.mean((without - full) ** 2)) <= 1e-4


@pytest.mark.full
def test_lights_in_one_place_become_one():
    """Their sum is exact there: and so are ambient ones', anywhere."""
    cache, camera, (near, far, *_) = scene(np.random.default_rng(4))
    copies = [PointLight(near.position, near.color * share) for share in (0.5, 0.3, 0.2)]
    ambient = [AmbientLight([0.1, 0.2, 0.3]), AmbientLight([0.3, 0.0, 0.1])]
    spot = lambda share: SpotLight([0, 0, 0], [0, 0.2, 1], [share] * 3, 0.2, 0.5)
    plan = Merged(((0, 1, 2), (3,), (4, 5), (6, 7)), ())
    lights = [*copies, far, *ambient, spot(0.5), spot(0.7)]
    picture = lambda brighter: plan(
        cache, camera, [PointLight(near.position, near.color * 0.5 * brighter), *lights[1:]]
    )
    fewer = [near, far, AmbientLight([0.4, 0.2, 0.4]), spot(1.2)]
    full = relight.render(cache, camera, fewer)
    np.testing.assert_allclose(picture(1.0), full, rtol=1e-9)
    slope = jax.jvp(picture, (1.0,), (1.0,))[1]
    alone = relight.shade(cache, camera, copies[0])
    np.testing.assert_allclose(slope, alone, rtol=1e-9)
    spots = [spot(share) for share in (0.5, 0.3, 0.2)]
    found = budget.relight(cache, camera, spots, max_error=1e-9)
    assert "what 3 lights have beyond 1 merged ones" in str(found)


def test_spot_lights_are_near_that_shine_alike():
    """Turned by 0.1 radians, or wider by as much, at a reach of 4 it is 0.4 away."""
    spot = lambda x, turn, wider: SpotLight(
        [x, 0, 0], [np.sin(turn), 0, np.cos(turn)], [1, 1, 1], 0.1, 0.5 + wider
    )
    for away in ((-0.3, 0, 0), (0, -0.07, 0), (0, 0, -0.07)):
        lights = spot(0, 0, 0), spot(0.4, 0, 0), spot(0, 0.1, 0), spot(0, 0, 0.1), spot(*away)
        places = {(n,): Place.of(light, 4.0) for n, light in enumerate(lights)}
        assert nearest(places, ()) == ((0,), (4,))


def test_a_negative_error_is_refused():
    with pytest.raises(ValueError, match=r"`relight\(max_error=...\)` must be a number"):
        inspect.unwrap(budget.relight)(*scene(np.random.default_rng(0)), max_error=-1)
