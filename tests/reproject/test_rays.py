"""View rays in a source's projected space, against projection point by point."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.reproject import camera
from jaxfx import OrthographicCamera
from jaxfx.reproject._rays import view_rays
from tests.helpers.forms import first


HEIGHT, WIDTH = 24, 32
POSE = camera(at=(0.7, 0.2, -0.4), turn=0.3).world_from_camera
TARGETS = {
    "pinhole": camera(at=(0.7, 0.2, -0.4), turn=0.3),
    "orthographic": OrthographicCamera(
        pixels_per_unit=8.0, center=[15.0, 11.0], world_from_camera=POSE
    ),
}


@jax.jit
def rays_of(source, target, pixels):
    unit = jnp.asarray(0.5)
    return view_rays(source, target, pixels, height=HEIGHT, width=WIDTH, unit=unit)


@first("kind", TARGETS)
def test_a_ray_is_the_line_that_its_pixel_sees(kind):
    """Each point of a ray, put back into the world, is seen by the target at its pixel."""
    source, target = camera(), TARGETS[kind]
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1, (200, 2)) * [WIDTH, HEIGHT]
    rays = jax.tree.map(np.asarray, rays_of(source, target, pixels))
    inside = rays.inside
    assert inside.mean() > 0.2
    for time in (0.1, 0.5, 0.9):
        runs_away = rays.direction[2] > 0  # and is at its origin at time 0
        x, y, negative = np.stack(rays.origin) + (time - runs_away) * np.stack(rays.direction)
        x, y, z = x[inside], y[inside], -0.5 / negative[inside]
        assert (z > 0.5 - 1e-9).all()
        assert (x > -1e-6).all() and (x < WIDTH + 1e-6).all()
        assert (y > -1e-6).all() and (y < HEIGHT + 1e-6).all()
        points = source.unproject(np.stack([x, y], axis=-1), z)
        seen, depth = target.project(points)
        np.testing.assert_allclose(seen, pixels[inside], atol=1e-8)
        assert (np.asarray(depth) > 0).all()


def test_equal_cameras_rays_stay_on_their_pixels_without_rounding():
    pixels = np.random.default_rng(0).uniform(0, 1, (50, 2)) * [WIDTH, HEIGHT]
    rays = jax.tree.map(np.asarray, rays_of(camera(), camera(), pixels))
    assert rays.inside.all()
    np.testing.assert_array_equal(np.stack(rays.origin[:2], axis=-1), pixels)
    np.testing.assert_array_equal(rays.direction[:2], 0)
