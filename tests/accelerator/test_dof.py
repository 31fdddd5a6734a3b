"""Depth of field whose accelerators' programs differ: both are held to the same oracles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof import diffusion
from jaxfx.dof.kernels import _layers
from jaxfx.dof.separable import _along_rows
from tests.dof.kernels.test_layers import (
    EXTENT,
    assert_close,
    check_derivatives,
    in_plain_numpy,
    random_sheets,
)
from tests.dof.test_behind import (  # noqa: F401
    test_a_third_layer_shows_past_the_second,
    test_clear_pixels_may_hold_anything,
)
from tests.dof.test_diffusion import (  # noqa: F401
    test_a_point_of_light_has_the_variance_of_its_disc,
    test_energy_is_kept_and_nothing_rings,
    test_implicit_is_two_dense_solves,
    test_implicit_keeps_its_digits_at_any_radius,
    test_nothing_flows_into_focus_or_past_a_bad_pixel,
)
from tests.dof.test_layered import (  # noqa: F401
    test_a_blurred_edge_before_a_plane_in_focus_shows_it_sharp,
    test_a_constant_image_is_kept,
    test_a_pixel_that_is_not_a_number_stays_local,
    test_a_second_layer_that_is_nowhere_is_none,
    test_a_sharp_edge_before_a_blurred_plane_stays_sharp,
    test_a_slanted_floor_lets_nothing_through,
    test_discs_inside_their_own_pixel_change_nothing,
)
from tests.dof.test_separable import (  # noqa: F401
    test_a_bad_pixel_spoils_its_square,
    test_a_point_of_light_has_the_variance_of_its_disc as test_a_point_keeps_its_variance,
    test_equals_the_loop,
)
from tests.helpers.quick import check_slopes


@pytest.mark.parametrize("method", [dof.implicit_diffusion, dof.separable])
def test_derivatives_are_difference_quotients(method):
    rng = np.random.default_rng(3)
    image, depth = rng.random((5, 6, 2)), rng.uniform(1.5, 9, (5, 6))

    def total(image, depth, aperture):
        lens = ThinLens(aperture, 3.0, 60.0)
        return method(image, depth, lens, max_coc=9.0)

    arguments = tuple(map(jnp.asarray, (image, depth, 0.2)))
    check_slopes(total, arguments, eps=1e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 3, 8, 13])
@pytest.mark.parametrize("scale", [0.0, 1.0, 1e8])
def test_both_eliminations_solve_the_dense_system(size, scale):
    """At any number of unknowns and any conductance, each to its own rounding."""
    rng = np.random.default_rng(size)
    conductance = scale * rng.random((size - 1, 1, 2))
    heat = rng.random((size, 3, 2))
    for solve in (diffusion._cyclic_reduction, diffusion._thomas):
        found = solve(jnp.asarray(conductance), jnp.asarray(heat))
        for lane in range(2):
            difference = np.diff(np.eye(size), axis=0)
            matrix = difference.T @ (conductance[:, 0, lane, None] * difference)
            expected = np.linalg.solve(np.eye(size) + matrix, heat[..., lane])
            # The dense system is as bad as its conductance is large; ours is not.
            np.testing.assert_allclose(found[..., lane], expected, rtol=1e-13 + 1e-16 * scale)


@pytest.mark.parametrize("together", [1, 2, 6, 40])
def test_any_number_of_taps_together_gives_the_same_pass(together):
    rng = np.random.default_rng(0)
    coc = rng.uniform(0, 7, (4, 9))
    planes = rng.random((3, 4, 9)), coc / 2 + 0.5, coc, coc, (coc > 1).astype(float)
    planes, epsilon = tuple(map(jnp.asarray, planes)), jnp.asarray(2.0)
    pass_of = lambda together: jax.jit(_along_rows, static_argnums=(2, 3))(
        planes, epsilon, 5, together
    )
    np.testing.assert_allclose(pass_of(together), pass_of(1), rtol=1e-13)


# With the number of slices known when the program is compiled, and not known.
@pytest.mark.parametrize("slices", [3, None])
def test_slices_are_composited_as_the_equations_have_it(slices):
    extent = EXTENT._replace(slices=slices)
    sheets = random_sheets(2)
    composited = jax.jit(_layers.composited, static_argnums=0)(extent, sheets)
    assert_close(composited, in_plain_numpy(3, sheets))


@pytest.mark.parametrize("slices", [3, None])
def test_the_derivatives_of_slices_are_those_of_dense_sums(slices):
    check_derivatives(EXTENT._replace(slices=slices))
