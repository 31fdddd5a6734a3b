"""Reprojection, as accelerators compute it: all rays in step, all sources at once."""

import importlib

import jax
import numpy as np
import pytest

from benchmarks.scenes.reproject import run
from jaxfx import PinholeCamera, reproject
from tests.cases.reproject import awkward_rays, field
from tests.reproject.test_blend import (  # noqa: F401
    test_images_of_two_types_give_the_first_ones,
    test_the_choice_is_what_shows_most_and_then_what_it_lacks,
    test_the_nearer_surface_hides_the_farther,
    test_two_sources_fill_each_others_gaps,
)
from tests.reproject.test_intersect import (  # noqa: F401
    check_exact,
    test_the_derivative_is_that_of_the_closed_form,
    test_under_vmap_every_ray_finds_the_same_in_as_many_steps,
)
from tests.reproject.test_traversal import test_a_bound_on_steps_is_kept_and_said  # noqa: F401
from tests.reproject.test_warp import (  # noqa: F401
    test_derivatives_of_the_pose_and_the_depth_are_the_difference_quotients,
    test_under_vmap_and_in_any_shape,
)


@pytest.mark.parametrize("shape", [(1, 1), (17, 13), (64, 64)])
def test_every_ray_meets_what_a_walk_over_every_texel_meets(shape):
    rng = np.random.default_rng(7)
    depth = field(shape, rng)
    origin, direction = awkward_rays(shape, rng)
    hit = run(depth, origin, direction)
    assert not hit.exhausted.any()
    assert check_exact(hit, depth, origin, direction, 1e-9) > 0


def test_parts_of_a_target_are_blended_as_each_source_is_warped(monkeypatch):
    """In parts of which none is as long as a row, and the last is not full."""
    blending = importlib.import_module("jaxfx.reproject.blend")
    monkeypatch.setattr(blending, "_RAYS_AT_ONCE", 27)
    monkeypatch.setattr(blending, "_WHOLE_PIXELS", 2)
    rng = np.random.default_rng(0)
    depth, image = rng.uniform(2, 2.1, (9, 11)), rng.random((9, 11, 3))
    there, pose = PinholeCamera.from_fov(0.9, height=9, width=11), np.eye(4)
    pose[0, 3] = 0.2
    target = PinholeCamera.from_fov(0.9, height=9, width=11, world_from_camera=pose)
    # Of two images with one camera the mean is seen.
    sources = [image, 3 * image], [depth, depth], [there, there]
    drawn, alpha = jax.jit(reproject.blend)(*sources, target)
    expected, mask = reproject.warp(2 * image, depth, there, target)
    np.testing.assert_array_equal(alpha, mask)
    assert 0 < alpha.mean() < 1
    np.testing.assert_allclose(drawn, expected, atol=1e-12)
    blend = lambda depth: reproject.blend(sources[0], [depth] * 2, sources[2], target)
    slope = jax.grad(lambda depth: blend(depth)[0].sum())
    same = jax.grad(lambda depth: reproject.warp(2 * image, depth, there, target)[0].sum())
    np.testing.assert_allclose(slope(depth), same(depth), atol=1e-9)
