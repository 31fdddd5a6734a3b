"""Relighting, as accelerators compute it: lights of a kind some at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxfx import relight
from jaxfx.relight import holes, shading
from tests.relight.test_holes import (  # noqa: F401
    test_a_filled_pixel_has_the_derivative_of_the_one_it_was_taken_from,
    test_any_size,
    test_is_the_nearest_covered_pixel,
    test_nothing_covered_leaves_everything,
)
from tests.relight.test_shading import (  # noqa: F401
    LIGHTS,
    loop,
    make_camera,
    make_gbuffer,
    test_gradients_of_render_equal_finite_differences,
    test_render_is_the_sum_of_lights,
    test_render_with_shadows_is_the_sum_of_shaded_lights,
)


@pytest.mark.parametrize("more", [0, 3])
def test_groups_of_lights_and_what_is_left_over(more):
    """As many lights as two groups hold, and some more, each by the loop over pixels."""
    gbuffer, camera = make_gbuffer(2), make_camera("pinhole", 7, 9)
    rng = np.random.default_rng(0)
    count = 2 * shading._TOGETHER + more
    lights = [type(LIGHTS["point"])(*rng.uniform(0.1, 1, (2, 3))) for _ in range(count)]
    shadows = [None if i % 3 else rng.uniform(0, 1, (7, 9)) for i in range(count)]
    each = [
        loop(gbuffer, camera, light) * (1 if shadow is None else shadow[..., None])
        for light, shadow in zip(lights, shadows, strict=True)
    ]
    image = relight.render(gbuffer, camera, lights, visibilities=shadows)
    np.testing.assert_allclose(image, sum(each), rtol=1e-10)
    colored = lambda color: relight.render(
        gbuffer, camera, [type(lights[0])(lights[0].position, color), *lights[1:]]
    )
    slope = jax.grad(lambda color: jnp.sum(colored(color)))(lights[0].color)
    alone = loop(gbuffer, camera, lights[0]) / np.asarray(lights[0].color)
    np.testing.assert_allclose(slope, alone.sum(axis=(0, 1)), rtol=1e-10)


@pytest.mark.parametrize("share", [0.0, 0.002, 0.02, 0.9])
def test_both_searches_across_find_the_same_pixel(share):
    """Wider than the first pass reaches: distances by SciPy, and equal ones broken alike."""
    rng = np.random.default_rng(0)
    covered = rng.random((40, 4 * holes._NEAR_COLUMNS)) < share
    both = []
    for search in (holes._widening, holes._in_two_passes):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(holes, "at_once", lambda cpu, accelerator, f=search: f)
            both.append(holes._nearest_covered(jnp.asarray(covered), jnp.asarray(~covered)))
    (found, near), (same, other) = both
    np.testing.assert_array_equal(found, same)
    assert found.all() == covered.any()
    if covered.any():
        np.testing.assert_array_equal(near, other)
        row, column = np.divmod(near, covered.shape[1])
        y, x = np.indices(covered.shape)
        distance = ndimage.distance_transform_edt(~covered)
        np.testing.assert_allclose(np.hypot(row - y, column - x), distance, atol=1e-12)
