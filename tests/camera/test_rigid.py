"""What cameras share, against matrix products written out in NumPy."""

import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.reproject import camera
from jaxfx.camera.rigid import per_depth, to_camera, to_world


def test_points_go_to_the_world_and_back():
    pose = np.asarray(camera(at=(0.7, 0.2, -0.4), turn=0.3).world_from_camera)
    points = np.random.default_rng(0).normal(size=(5, 3))
    world = points @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(to_world(jnp.asarray(pose), jnp.asarray(points)), world)
    back = to_camera(jnp.asarray(pose), jnp.asarray(world))
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_a_ray_advances_by_the_difference_of_two_of_its_points():
    eye = camera(at=(0.7, 0.2, -0.4), turn=0.3)
    pixels = jnp.asarray([[0.5, 3.0], [20.0, 11.0]])
    near, far = (eye.unproject(pixels, jnp.full(2, depth)) for depth in (2.0, 3.0))
    np.testing.assert_allclose(per_depth(eye, pixels), far - near, atol=1e-12)
