"""The pose of a rendered view is found again; what is wrong with the arguments is said."""

import functools
import inspect
import re

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera, fit, relight, scene
from tests.helpers.forms import first


SIDE = 128


@functools.cache
def pictures():
    """The still life from its own camera, and as a photograph from two degrees aside."""
    life = scene.still_life()
    eye = scene.default_camera(life, height=SIDE, width=SIDE)
    lights = scene.default_lights(eye)
    true = moved(eye, (0.2, 1, 0.1), 2.0, (0.08, 0.02, 0.05))

    def taken(eye):
        buffer = scene.gbuffer(life, eye, height=SIDE, width=SIDE)
        return relight.render(buffer, eye, lights), buffer.depth

    image, depth = taken(eye)
    return taken(true)[0], image, depth, eye, true


def moved(eye, axis, degrees, shift):
    """A camera turned about an axis and shifted, both in its own frame."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    motion = np.eye(4)
    motion[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = shift
    pose = np.asarray(eye.world_from_camera, float) @ motion
    return PinholeCamera(eye.intrinsics, jnp.asarray(pose, eye.intrinsics.dtype))


def apart(one, other):
    """The rotation from one pose to another, in degrees, and the shift, in the other's axes."""
    a, b = (np.asarray(eye.world_from_camera, float) for eye in (one, other))
    turn = b[:3, :3].T @ a[:3, :3]
    sines = np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    angle = np.rad2deg(np.arcsin(np.linalg.norm(sines) / 2))
    return angle, b[:3, :3].T @ (a[:3, 3] - b[:3, 3])


@first("seed", range(3))
@pytest.mark.full
def test_a_rendered_views_pose_is_recovered(seed):
    reference, image, depth, source, true = pictures()
    rng = np.random.default_rng(seed)
    scale = float(np.median(depth))
    shift = rng.normal(size=3)
    shift *= 0.03 * scale / np.linalg.norm(shift)
    start = moved(true, rng.normal(size=3), 3.0, shift)
    found = fit.camera(reference, image, depth, source, start, progress=False)
    angle, distance = apart(found.camera, true)
    assert found.success and found.share > 0.3
    assert angle < 0.05 and np.linalg.norm(distance) < 1e-3 * scale
    # The error is of the size that is stated, blur and aliasing taken for noise.
    assert (np.abs(distance) < 10 * found.uncertainty[:3]).all()
    assert np.deg2rad(angle) < 10 * np.linalg.norm(found.uncertainty[3:]) < 2e-3
    assert found.losses[-1] < 0.2 * found.losses[0]
    assert jnp.allclose(found.camera.intrinsics, start.intrinsics)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("hole", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.full
def test_one_hole_in_the_depth_has_no_say(hole, dtype):
    y, x = np.mgrid[:32, :32] / 32
    image = np.stack([np.sin(9 * x + 3 * y), np.cos(7 * y), np.sin(5 * x * y)], -1) / 2 + 0.5
    eye = PinholeCamera.from_fov(1.0, height=32, width=32)
    depth = np.full((32, 32), 2, dtype)
    depth[10, 20] = hole
    pictures = [image.astype(dtype)] * 2
    found = fit.camera(*pictures, depth, eye, eye, throw=False, progress=False)
    assert found.success and float(found.losses[0]) < 1e-12
    # All but those that look within two texels of the hole, and those beside.
    assert float(found.share) == pytest.approx(1 - 49 / 32**2)
    assert np.isfinite(found.uncertainty).all()
    np.testing.assert_allclose(found.camera.world_from_camera, eye.world_from_camera, atol=1e-5)


@pytest.mark.full
def test_a_pose_is_recovered_from_a_depth_with_holes():
    """As a depth camera leaves them: blobs, and a strip beside each step."""
    reference, image, depth, source, true = pictures()
    depth, rng = np.array(depth), np.random.default_rng(0)
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    lost = np.zeros(depth.shape, bool)
    for _ in range(6):
        cx, cy = rng.uniform(0, SIDE, 2)
        lost |= (x - cx) ** 2 + (y - cy) ** 2 < 16
    step = np.abs(np.diff(depth, axis=1, append=depth[:, -1:])) > 0.1 * depth
    lost |= step | np.roll(step, 1, axis=1)
    depth[lost] = rng.choice([0, -1, np.nan], lost.sum())
    start = moved(true, (1, 0.3, 0.2), 2.0, (0.03, 0.02, -0.03))
    found = fit.camera(reference, image, depth, source, start, progress=False)
    angle, distance = apart(found.camera, true)
    assert found.success and angle < 0.1 and np.linalg.norm(distance) < 0.01


@pytest.mark.full
def test_failure_is_said():
    reference, image, depth, source, true = pictures()
    away = moved(true, (0, 1, 0), 180.0, (0, 0, 0))
    with pytest.raises(RuntimeError, match=r"found no pose .* over 0 % of the"):
        fit.camera(reference, image, depth, source, away, progress=False)
    lost = fit.camera(reference, image, depth, source, away, throw=False, progress=False)
    assert lost.share == 0 and jnp.isinf(lost.uncertainty).all() and not lost.success


FAULTS = {
    "camera(reference)": {"reference": np.ones((8, 8, 1))},
    "camera(image)": {"image": np.full((8, 8, 3), np.nan)},
    "camera(depth)": {"depth": np.ones((8, 9))},
    "camera(source)": {"source": OrthographicCamera(1.0, [0.0, 0.0], np.eye(4))},
    "camera(start)": {"start": OrthographicCamera(1.0, [0.0, 0.0], np.eye(4))},
    "camera(hole_threshold=...)": {"hole_threshold": 0},
    "camera(max_steps=...)": {"max_steps": 0},
}


@pytest.mark.parametrize(("name", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(name, fault):
    eye = PinholeCamera.from_fov(1.0, height=8, width=8)
    given = {"reference": np.ones((8, 8, 3)), "image": np.ones((8, 8, 3))}
    given |= {"depth": np.ones((8, 8)), "source": eye, "start": eye}
    with pytest.raises(ValueError, match=re.escape(f"`{name}`")):
        inspect.unwrap(fit.camera)(**given | fault, progress=False)


def test_a_depth_that_is_nowhere_known_is_named():
    eye = PinholeCamera.from_fov(1.0, height=8, width=8)
    image, depth = np.ones((8, 8, 3)), np.full((8, 8), np.inf)
    with pytest.raises(ValueError, match=re.escape("`camera(depth)`")):
        fit.camera(image, image, depth, eye, eye, progress=False)
