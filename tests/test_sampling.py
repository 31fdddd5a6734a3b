"""Where pixels are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxfx import PinholeCamera
from jaxfx._sampling import bilinear, nearest, pixel_centers


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 2)])
def test_pixel_centers(height, width):
    centers = np.asarray(pixel_centers(height, width))
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
    points = np.asarray(camera.unproject(centers, np.full((3, 5), 2.0)))
    np.testing.assert_allclose(points[1, 2], [0, 0, 2], atol=1e-15)
    # Rows go down and columns to the right, like the camera's y and x.
    assert np.all(np.diff(points[..., 0], axis=1) > 0)
    assert np.all(np.diff(points[..., 1], axis=0) > 0)


def points_about(height, width, count=400):
    rng = np.random.default_rng(0)
    return rng.uniform([-2, -2], [width + 2, height + 2], (count, 2))


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5), (6, 9, 2, 2)])
def test_bilinear_is_scipys(shape):
    image = np.random.default_rng(1).normal(size=shape)
    points = points_about(*shape[:2])
    rows_first = points[:, ::-1].T - 0.5
    planes = image.reshape(*shape[:2], -1)
    expected = np.stack(
        [
            ndimage.map_coordinates(planes[..., k], rows_first, order=1, mode="nearest")
            for k in range(planes.shape[-1])
        ],
        axis=-1,
    )
    read = bilinear(jnp.asarray(image), jnp.asarray(points))
    np.testing.assert_allclose(np.asarray(read).reshape(len(points), -1), expected, atol=1e-12)


def test_bilinear_gives_pixels_back_and_has_one_sided_slopes_there():
    image = np.random.default_rng(2).normal(size=(4, 5))
    read = jax.jit(lambda points: bilinear(jnp.asarray(image), points))
    centers = np.asarray(pixel_centers(4, 5))
    np.testing.assert_array_equal(read(centers), image)
    slope = jax.jit(jax.grad(read))(centers[1, 2])
    np.testing.assert_allclose(
        slope, [image[1, 3] - image[1, 2], image[2, 2] - image[1, 2]], rtol=1e-12
    )


def test_bilinear_leaves_out_what_has_no_share():
    image = jnp.asarray([[1.0, jnp.inf], [3.0, jnp.nan]])
    np.testing.assert_array_equal(bilinear(image, jnp.asarray([0.5, 1.0])), 2.0)


def test_nearest_is_the_covering_pixel():
    image = np.arange(20).reshape(4, 5)
    points = points_about(4, 5)
    x = np.clip(np.floor(points[:, 0]), 0, 4).astype(int)
    y = np.clip(np.floor(points[:, 1]), 0, 3).astype(int)
    np.testing.assert_array_equal(nearest(jnp.asarray(image), jnp.asarray(points)), image[y, x])
    assert nearest(jnp.asarray(image), jnp.asarray([np.nan, np.nan])).shape == ()
