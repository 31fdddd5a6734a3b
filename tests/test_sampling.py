"""Where pixels are."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import PinholeCamera
from jaxfx._sampling import pixel_centers


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 2)])
def test_pixel_centers(height, width):
    centers = pixel_centers(height, width)
    assert centers.shape == (height, width, 2)
    for row in range(height):
        for column in range(width):
            np.testing.assert_array_equal(centers[row, column], [column + 0.5, row + 0.5])


def test_types():
    assert pixel_centers(2, 3).dtype == jnp.float64
    assert pixel_centers(2, 3, jnp.float32).dtype == jnp.float32


def test_the_middle_pixel_sees_along_the_axis():
    camera = PinholeCamera.from_fov(0.8, height=3, width=5)
    centers = pixel_centers(3, 5)
    points = camera.unproject(centers, jnp.full((3, 5), 2.0))
    np.testing.assert_allclose(points[1, 2], [0, 0, 2], atol=1e-15)
    # Rows go down and columns to the right, like the camera's y and x.
    assert np.all(np.diff(points[..., 0], axis=1) > 0)
    assert np.all(np.diff(points[..., 1], axis=0) > 0)
