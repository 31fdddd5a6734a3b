"""Cameras at lights."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import AmbientLight, DirectionalLight, PointLight, SpotLight, shadow


WHITE = [1.0, 1.0, 1.0]
POINT = PointLight([0.6, 2.2, -1.6], WHITE)
LIGHTS = {
    "sun": DirectionalLight([0.4, -1.0, -0.3], WHITE),
    "spot": SpotLight([0.6, 2.5, -0.5], [-0.1, -1.0, -0.8], WHITE, 0.5, 0.8),
    "point": POINT,
}


def test_a_directional_light_takes_in_the_ball():
    center, radius = np.array([1.0, 2.0, 3.0]), 2.0
    (camera,) = shadow.light_cameras(
        LIGHTS["sun"], map_size=64, scene_center=center, scene_radius=radius, margin=4
    )
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    points = center + radius * points / np.linalg.norm(points, axis=-1, keepdims=True)
    pixels, z = map(np.asarray, camera.project(points))
    assert 4 <= pixels.min() < 5
    assert 59 < pixels.max() <= 60
    assert 2 <= z.min() < z.max() <= 6
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    expected = np.array([0.4, -1.0, -0.3]) / np.linalg.norm([0.4, -1.0, -0.3])
    np.testing.assert_allclose(forward, expected, rtol=1e-12)


def test_every_pose_is_a_rotation():
    for light in LIGHTS.values():
        for camera in shadow.light_cameras(light, map_size=8):
            turn = np.asarray(camera.world_from_camera)[:3, :3]
            np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(turn) == pytest.approx(1)


def test_six_faces_hold_every_direction_inside_their_margin():
    cameras = shadow.light_cameras(POINT, map_size=32, margin=3)
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    depths, inside = [], []
    for camera in cameras:
        pixels, z = map(np.asarray, camera.project(np.asarray(POINT.position) + directions))
        depths.append(z)
        inside.append((z > 0) & (pixels >= 3).all(axis=-1) & (pixels <= 29).all(axis=-1))
    nearest = np.argmax(depths, axis=0)
    assert np.take_along_axis(np.array(inside), nearest[None], axis=0).all()


def test_an_ambient_light_has_no_shadow():
    assert shadow.light_cameras(AmbientLight(WHITE), map_size=8) == ()


def test_gradients_reach_the_light():
    def eye(light):
        camera = shadow.light_cameras(light, map_size=8)[0]
        return jnp.sum(camera.world_from_camera[:3, 3] * jnp.arange(1.0, 4.0))

    slopes = jax.jit(jax.grad(eye))
    assert np.abs(slopes(LIGHTS["sun"]).direction).max() > 0.1
    np.testing.assert_allclose(slopes(POINT).position, [1, 2, 3])


def test_errors_name_their_argument():
    function = inspect.unwrap(shadow.light_cameras)
    wide = SpotLight([0, 0, 0], [0, 0, 1], WHITE, 0.5, 1.6)
    for name, light, options in (
        ("margin=...", POINT, {"margin": 4}),
        ("scene_radius=...", POINT, {"scene_radius": 0.0}),
        ("light", wide, {}),
        ("light", "sun", {}),
    ):
        with pytest.raises(ValueError) as caught:
            function(light, **({"map_size": 8} | options))
        assert str(caught.value).startswith(f"`light_cameras({name})`")
