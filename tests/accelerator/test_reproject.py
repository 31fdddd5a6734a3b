"""Reprojection, as accelerators compute it: all rays in step, all sources at once."""

import numpy as np
import pytest

from benchmarks.scenes.reproject import run
from tests.cases.reproject import awkward_rays, field
from tests.reproject.test_blend import (  # noqa: F401
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
