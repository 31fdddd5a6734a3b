"""Relighting, as accelerators compute it: lights of a kind some at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import relight
from jaxfx.relight import shading
from tests.relight.test_shading import (  # noqa: F401
    LIGHTS,
    loop,
    make_camera,
    make_gbuffer,
    test_gradients_of_render_equal_finite_differences,
    test_render_is_the_sum_of_lights,
    test_render_with_shadows_is_the_sum_of_shaded_lights,
)
from tests.relight.test_state import (  # noqa: F401
    test_a_bad_pixel_stays_where_it_is,
    test_a_bright_light_leaves_no_trace,
    test_a_chain_of_edits_of_several_kinds_does_not_drift,
    test_a_light_that_is_not_finite_leaves_no_trace,
    test_derivatives_in_the_cache_are_those_of_render,
    test_derivatives_in_the_edited_light_are_those_of_shading_it,
    test_every_method_gives_the_picture_of_its_lights,
    test_ten_thousand_edits_in_a_loop_do_not_drift,
    test_visibility_goes_with_its_light,
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
