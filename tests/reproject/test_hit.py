"""Bilinear reads inside one surface, against SciPy's and by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import ndimage

from jaxfx.reproject._hit import edge_aware_patch


@functools.partial(jax.jit, static_argnames="step")
def reads(depth, image, x, y, inverse_depth, step):
    """Depth and colors at places of the image, by the patch about each of them."""
    patch = edge_aware_patch(depth, x, y, inverse_depth, step)
    return patch.read(depth), patch.read_colors(image)


def test_a_surface_without_a_step_is_read_as_scipy_reads_it():
    rng = np.random.default_rng(0)
    depth, image = -rng.uniform(0.4, 0.5, (7, 9)), rng.random((7, 9, 3))
    x, y = rng.uniform(-1, 10, 60), rng.uniform(-1, 8, 60)
    found_depth, found_colors = reads(depth, image, x, y, np.full(60, -0.45), None)
    read = lambda plane: ndimage.map_coordinates(
        plane, [y - 0.5, x - 0.5], order=1, mode="nearest"
    )
    np.testing.assert_allclose(found_depth, read(depth), atol=1e-14)
    expected = np.stack([read(image[..., k]) for k in range(3)], axis=-1)
    np.testing.assert_allclose(found_colors, expected, atol=1e-14)


def test_a_texel_of_another_surface_has_no_share():
    """A wall at 1 beside one at 2, and a texel that is unknown: -1 / z."""
    depth = np.array([[-1.0, -0.5], [-1.0, np.inf]])
    image = np.array([[10.0, 20.0], [30.0, np.nan]])[..., None]
    x, y = np.array([1.1, 1.1]), np.array([0.9, 0.9])
    _, found = reads(depth, image, x, y, np.array([-1.0, -0.5]), 0.1)
    np.testing.assert_allclose(np.ravel(found), [10 * 0.6 + 30 * 0.4, 20])


@pytest.mark.full
def test_its_derivatives_are_difference_quotients():
    rng = np.random.default_rng(1)
    depth, image = -rng.uniform(0.4, 0.5, (6, 6)), jnp.asarray(rng.random((6, 6, 2)))
    at = jnp.asarray(rng.uniform(1, 5, (2, 8)))

    def colors(at, image):
        at, image = jnp.asarray(at), jnp.asarray(image)
        return edge_aware_patch(jnp.asarray(depth), *at, jnp.full(8, -0.45), None).read_colors(
            image
        )

    check_grads(colors, (at, image), order=1, modes=("fwd", "rev"), rtol=1e-6)
