"""Normals from images, against those that the images were made with."""

import numpy as np
import pytest

from jaxfx import GBuffer, PinholeCamera, relight


def unit_normals(shape=(9, 11)):
    """Every octant, the axes themselves, and nothing."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[0, :6] = np.concatenate([np.eye(3), -np.eye(3)])
    normal[0, 6] = 0
    return normal


def lambert(normal, exposure):
    """A renderer of its own: white, one-sided, lit from where the light comes."""

    def render(lights):
        image = np.zeros(normal.shape)
        for light in lights:
            cosine = np.maximum(normal @ -np.asarray(light.direction), 0)
            image += cosine[..., None] * np.asarray(light.color) * exposure
        return image.astype(normal.dtype)

    return render


@pytest.mark.parametrize("exposure", [1.0, 1 / np.pi])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equals_the_true_normals_on_both_signs(dtype, exposure):
    normal = unit_normals().astype(dtype)
    found = relight.capture_normals(lambert(normal, exposure))
    np.testing.assert_allclose(found, normal, rtol=0, atol=1e-6)


def test_lights_are_coloured_and_on_either_side_in_turn():
    asked = []

    def render(lights):
        asked.append([(*map(tuple, map(np.asarray, (o.direction, o.color))),) for o in lights])
        return np.ones((1, 1, 3))

    relight.capture_normals(render)
    axes = [tuple(axis) for axis in np.eye(3)]
    assert asked[0] == [(tuple(-np.array(axis)), axis) for axis in axes]
    assert asked[1] == [(axis, axis) for axis in axes]


def test_of_our_own_renderer():
    normal = unit_normals()
    white = np.ones(normal.shape)
    shader = np.where((normal == 0).all(axis=-1), -1, 0)
    depth = np.where(shader == 0, 2.0, np.inf)
    gbuffer = GBuffer(white, shader, white, white, 0 * white, normal, depth, white[..., 0])
    camera = PinholeCamera.from_fov(1.0, height=9, width=11)
    found = relight.capture_normals(lambda lights: relight.render(gbuffer, camera, lights))
    np.testing.assert_allclose(found, normal, rtol=0, atol=1e-6)


def test_errors_name_the_argument():
    for image in (np.ones((2, 2, 4)), np.ones((2, 2)), np.ones((2, 2, 3), int)):
        with pytest.raises(ValueError, match=r"`capture_normals\(render\)` must"):
            relight.capture_normals(lambda lights, image=image: image)
