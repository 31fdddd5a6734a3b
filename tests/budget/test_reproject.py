"""Plans for reprojection."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import PinholeCamera, budget, reproject


SIZE = (10, 12)


def along(x):
    """A camera of the scene, moved to the right by `x`."""
    pose = np.eye(4)
    pose[0, 3] = x
    height, width = SIZE
    return PinholeCamera.from_fov(1.0, height=height, width=width, world_from_camera=pose)


def scene(rng):
    """A wall, flat or rough, seen by two cameras that paint it nearly the same."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] / 10
    cameras, images = [along(0.0), along(rng.uniform(0.01, 0.6))], []
    for _ in cameras:
        noise = 10 ** rng.uniform(-4, -1) * rng.normal(size=(*SIZE, 1))
        images.append(np.stack([0.5 + 0.3 * np.sin(2 * x + y)], axis=-1) + noise)
    rough = rng.choice([0, 0.5]) * rng.normal(size=SIZE)
    return images, [4 + rough] * 2, cameras, cameras[0]


@pytest.fixture(scope="module")
def plans(promised):
    return promised(scene, budget.reproject, reproject.blend, (-3.5, -0.5))


def test_no_plan_exceeds_its_error(plans):
    plans.are_kept()


def test_the_error_allowed_is_made_use_of(plans):
    plans.are_made_use_of(0.3)


def test_some_plans_leave_a_source_out_and_some_a_few_tiles_of_it(plans):
    texts = [str(plan) for plan, _, _ in plans]
    assert any("all of sources 1, where others show next to the same" in text for text in texts)
    assert any("% of the rays, where" in text for text in texts)
    assert any("steps of a ray after" in text for text in texts)


@pytest.mark.full
def test_a_plan_knows_what_the_effect_knows(later_is_quicker):
    """A source that alone sees some pixels is drawn there, however much error is allowed."""
    images, depths, cameras, _ = scene(np.random.default_rng(0))
    data = (images, depths, cameras, along(2.0))
    known = reproject.blend(*data)[1]
    assert 0 < known.mean() < 1
    plan = budget.reproject(*data, max_error=10.0)
    assert "% of the rays" in str(plan)
    np.testing.assert_array_equal(plan(*data)[1], known)


@pytest.mark.full
def test_rays_that_show_nothing_are_cut_short(later_is_quicker):
    """Between posts they go on, out of the image, and no pixel needs what they would show."""
    posts = np.where(np.arange(SIZE[1]) % 6 < 1, 2.0, 6.0) * np.ones(SIZE)
    image = np.random.default_rng(1).random((*SIZE, 1))
    data = [image], [posts], [along(0.0)], along(2.0)
    plan = budget.reproject(*data, max_error=0.0)
    assert "steps of a ray after" in str(plan)
    for own, exact in zip(plan(*data), reproject.blend(*data), strict=True):
        np.testing.assert_array_equal(own, exact)

    @eqx.filter_jit
    def slopes(call, depth, tangent):
        image = lambda depth: call(data[0], [depth], *data[2:])[0]
        pulled = jax.vjp(image, depth)[1](jnp.ones((*SIZE, 1)))[0]
        return pulled, jnp.sum(jax.jvp(image, (depth,), (tangent,))[1])

    tangent = np.random.default_rng(0).normal(size=SIZE)
    pulled, pushed = slopes(plan, posts, tangent)
    np.testing.assert_allclose(jnp.sum(pulled * tangent), pushed, atol=1e-12)
    exact = slopes(reproject.blend, posts, tangent)[0]
    assert np.abs(exact).max() > 0.01
    np.testing.assert_allclose(pulled, exact, atol=1e-12)


@pytest.mark.full
def test_steps_that_show_something_are_taken(later_is_quicker):
    """Though the error allowed is more than they make: without them pixels would be lost."""
    ((image, _), (depth, _), (camera, _), _) = scene(np.random.default_rng(2))
    data = [image], [depth], [camera], along(1.0)
    plan = budget.reproject(*data, max_error=0.2)
    np.testing.assert_array_equal(plan(*data)[1], reproject.blend(*data)[1])


def test_where_nothing_is_seen_the_plan_sees_nothing(later_is_quicker):
    images, depths, cameras, _ = scene(np.random.default_rng(0))
    data = images, depths, cameras, along(100.0)
    plan = budget.reproject(*data, max_error=0.1)
    assert np.asarray(plan(*data)[1]).sum() == 0


def test_the_result_has_the_size_asked_for(later_is_quicker):
    data = scene(np.random.default_rng(0))
    plan = budget.reproject(*data, height=5, width=7, max_error=0.1)
    assert plan(*data)[0].shape == (5, 7, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_error": -1}, r"`reproject\(max_error=...\)` must be a number"),
        ({"max_error": 1, "height": 3}, r"`reproject\(width=...\)` must be a positive integer"),
        ({"max_error": 1, "height": 0, "width": 3}, r"`reproject\(height=...\)` must be"),
    ],
)
def test_a_wrong_argument_is_refused(options, message):
    data = scene(np.random.default_rng(0))
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(budget.reproject)(*data, **options)
