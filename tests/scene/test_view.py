"""The default camera and lights of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfx import AmbientLight, DirectionalLight, scene


def test_default_camera_frames_any_mesh():
    for sides in [(1, 1, 1), (9, 0.1, 0.1), (0.1, 9, 0.1), (0.1, 0.1, 9), (4, 0, 4)]:
        mesh = trimesh.creation.box((1, 1, 1))
        mesh.apply_scale(sides)
        mesh.apply_translation([50, -20, 30])
        box = scene.from_trimesh(mesh)
        for height, width in [(60, 60), (40, 90), (90, 40)]:
            camera = scene.default_camera(box, height=height, width=width)
            pixels, depth = jax.vmap(camera.project)(jnp.asarray(box.vertices))
            inset = np.minimum(
                np.asarray(pixels), np.array([width, height]) - np.asarray(pixels)
            )
            assert (np.asarray(depth) > 0).all()
            assert (np.asarray(inset) > 0.04 * min(height, width)).all()
            reach = np.ptp(np.asarray(pixels), axis=0) / [width, height]
            assert reach.max() > 0.3
            middle, _ = camera.project(jnp.asarray(box.center))
            np.testing.assert_allclose(middle, [width / 2, height / 2], atol=1e-6)


def test_default_camera_takes_the_scenes_own_viewpoint():
    room = scene.still_life()
    for height, width in [(60, 80), (80, 60)]:
        camera = scene.default_camera(room, height=height, width=width)
        np.testing.assert_allclose(camera.world_from_camera[:3, 3], room.viewpoint.eye)
        shorter = min(height, width) / 2
        half = np.arctan(shorter / float(camera.intrinsics[0, 0]))
        assert 2 * half == pytest.approx(room.viewpoint.fov)


def test_default_camera_wants_a_size(ball):
    with pytest.raises(ValueError, match=r"scene\.default_camera\(width=\.\.\.\).*got 0"):
        scene.default_camera(ball, height=9, width=0)


def test_default_lights_shine_from_behind_the_camera(ball):
    camera = scene.default_camera(ball, height=60, width=80)
    key, fill, ambient = scene.default_lights(camera)
    assert isinstance(ambient, AmbientLight)
    right, down, forward = np.asarray(camera.world_from_camera)[:3, :3].T
    for light, side in ((key, 1), (fill, -1)):
        assert isinstance(light, DirectionalLight)
        direction = np.asarray(light.direction)
        assert direction @ forward > 0
        assert direction @ down > 0
        assert side * (direction @ right) > 0
    assert np.asarray(key.color).sum() > 2 * np.asarray(fill.color).sum()
