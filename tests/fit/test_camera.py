"""`fit.camera`: the pose of a rendered view is recovered; wrong arguments are named."""

import functools
import inspect
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera, fit, relight, scene
from jaxfx.fit import _pose_residual, _pose_search
from jaxfx.fit._descent import linear
from tests.cases import rooms
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
    # The error is of the size that is stated.
    assert (np.abs(distance) < 4 * found.standard_errors["translation"]).all()
    assert np.deg2rad(angle) < 4 * np.linalg.norm(found.standard_errors["rotation"]) < 2e-3
    assert found.losses[-1] < 0.2 * found.losses[0]
    assert jnp.allclose(found.camera.intrinsics, start.intrinsics)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("hole", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.full
def test_one_hole_in_the_depth_does_not_count(hole, dtype):
    y, x = np.mgrid[:32, :32] / 32
    image = np.stack([np.sin(9 * x + 3 * y), np.cos(7 * y), np.sin(5 * x * y)], -1) / 2 + 0.5
    eye = PinholeCamera.from_fov(1.0, height=32, width=32)
    depth = np.full((32, 32), 2, dtype)
    depth[10, 20] = hole
    pictures = [image.astype(dtype)] * 2
    found = fit.camera(*pictures, depth, eye, eye, throw=False, progress=False)
    assert found.success and float(found.losses[0]) < 1e-12
    # All but the frame, and those that see the hole or stand beside; a sky is a step in depth.
    ignored = 49 if hole == np.inf else 9
    assert float(found.share) == pytest.approx((26**2 - ignored) / 32**2)
    assert all(np.isfinite(errors).all() for errors in found.standard_errors.values())
    np.testing.assert_allclose(found.camera.world_from_camera, eye.world_from_camera, atol=1e-5)


def test_the_unit_of_translations_is_the_median_depth_of_what_is_near():
    """Of a large image with a sky, where one pixel in 49 is known, not in a square's middle."""
    rng, size = np.random.default_rng(0), (330, 500)
    depth, known = np.zeros(size), np.zeros(size, bool)
    known[::7, 1::7] = True
    depth[known] = rng.uniform(2, 5, known.sum())
    sky = known & (np.arange(size[0])[:, None] < 200)
    depth[sky] = 1e10
    near = np.median(depth[known & ~sky])
    assert abs(float(_pose_search._unit(jnp.asarray(depth))) - near) < 0.1 * near


@pytest.mark.full
def test_a_sky_over_most_of_the_image_is_one_at_infinity():
    """The number that a renderer writes for it decides neither the pose nor its error.

    In float64: the position is so unsure that in float32 rounding decides where a search ends.
    """
    y, x = np.mgrid[:32, :32] / 32
    image = np.stack([np.sin(9 * x + 3 * y), np.cos(7 * y), np.sin(5 * x * y)], -1) / 2 + 0.5
    image[22:] = 0.5  # Without a texture the near part leaves the position unsure.
    noise = np.random.default_rng(0).normal(0, 0.01, image.shape)
    pictures = [image + noise, image]
    eye = PinholeCamera.from_fov(0.9, height=32, width=32)
    start = moved(eye, (0, 1, 0), 0.0, (0.3, 0, 0))

    def fitted(sky):
        depth = np.full((32, 32), 2.0)
        depth[:22] = sky
        return fit.camera(*pictures, depth, eye, start, throw=False, progress=False)

    expected = fitted(np.inf)
    for sky in (1e10, 3e38):
        found = fitted(sky)
        assert float(found.reach) == 2 and found.success == expected.success
        np.testing.assert_allclose(found.wander, expected.wander, rtol=0.01)
        np.testing.assert_allclose(
            found.camera.world_from_camera, expected.camera.world_from_camera, atol=1e-3
        )


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
def test_failure_is_stated():
    reference, image, depth, source, true = pictures()
    away = moved(true, (0, 1, 0), 180.0, (0, 0, 0))
    with pytest.raises(RuntimeError, match=r"found no pose .*: Both see only 0 % of"):
        fit.camera(reference, image, depth, source, away, progress=False)
    lost = fit.camera(reference, image, depth, source, away, throw=False, progress=False)
    assert lost.share == 0 and not lost.success
    assert all(jnp.isinf(errors).all() for errors in lost.standard_errors.values())


FAULTS = {
    "camera(reference)": {"reference": np.ones((8, 8, 1))},
    "camera(image)": {"image": np.full((8, 8, 3), np.nan)},
    "camera(depth)": {"depth": np.ones((8, 9))},
    "camera(camera)": {"camera": OrthographicCamera(1.0, [0.0, 0.0], np.eye(4))},
    "camera(start)": {"start": OrthographicCamera(1.0, [0.0, 0.0], np.eye(4))},
    "camera(hole_threshold=...)": {"hole_threshold": 0},
    "camera(max_steps=...)": {"max_steps": 0},
    "camera(exposure=...)": {"exposure": "auto"},
    "camera(reference_depth=...)": {"reference_depth": np.ones((8, 9))},
}


@pytest.mark.parametrize(("name", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(name, fault):
    eye = PinholeCamera.from_fov(1.0, height=8, width=8)
    given = {"reference": np.ones((8, 8, 3)), "image": np.ones((8, 8, 3))}
    given |= {"depth": np.ones((8, 8)), "camera": eye, "start": eye}
    with pytest.raises(ValueError, match=re.escape(f"`{name}`")):
        inspect.unwrap(fit.camera)(**given | fault, progress=False)


def test_a_depth_that_is_nowhere_known_is_named():
    eye = PinholeCamera.from_fov(1.0, height=8, width=8)
    image, depth = np.ones((8, 8, 3)), np.full((8, 8), np.inf)
    with pytest.raises(ValueError, match=re.escape("`camera(depth)`")):
        fit.camera(image, image, depth, eye, eye, progress=False)


def taken(seed, turn, shift, size=(72, 96), noise=0.01):
    """Two photographs of a room with depth, the second turned and shifted; its true pose."""
    rng = np.random.default_rng([seed, 1])
    first = rooms.pose(rng.uniform(-3, 3), 0, rng.uniform(-0.3, 0.3, 3))
    second = first @ rooms.pose(turn, rng.uniform(-0.1, 0.1), shift)
    place = rooms.room(seed)
    image, depth, source = rooms.seen(place, first, size)
    reference, own, target = rooms.seen(place, second, size)
    exposed = rng.uniform(0.8, 1.25) * reference
    grain = lambda image: (image + noise * rng.normal(size=image.shape)).astype(np.float32)
    return grain(exposed), grain(image), depth, source, own, target


def pairs(count):
    """Of every overlap: half start near the truth, half from the source's own pose."""
    for seed in range(count):
        rng = np.random.default_rng([seed, 2])
        turn = rng.uniform(0, 1.2) * rng.choice([-1, 1])
        shift = rng.normal(size=3) * rng.uniform(0, 0.2)
        reference, image, depth, source, _, true = taken(seed, turn, shift)
        start = source
        if seed % 2:
            start = moved(true, rng.normal(size=3), 2.0, rng.normal(size=3) * 0.03)
        found = fit.camera(reference, image, depth, source, start, throw=False)
        angle, distance = apart(found.camera, true)
        yield found, angle, distance


@pytest.mark.full
def test_success_means_a_right_pose_and_errors_are_of_the_size_that_is_stated():
    """Rooms, seen twice with 0 to 100 % in common, exposed apart and with noise."""
    count, false_alarms, missed, within = 60, 0, 0, []
    for found, angle, distance in pairs(count):
        is_right = angle < 1 and np.linalg.norm(distance) < 0.05
        false_alarms += is_right and not found.success
        missed += found.success and not is_right
        if is_right:
            within.append(
                np.abs(distance) < 1.96 * np.asarray(found.standard_errors["translation"])
            )
    assert missed <= 0.02 * count and false_alarms <= 0.05 * count
    assert 0.4 * count < len(within) < 0.9 * count
    assert np.mean(within, axis=0).min() >= 0.85


@pytest.mark.full
def test_the_residual_has_the_derivative_of_its_difference_quotient():
    """Images, exposure and both depths, in a room without edges in sight; both modes."""
    size, place = (24, 32), rooms.room(2, boxes=0)
    first = rooms.pose(0.2, 0, np.zeros(3))
    image, depth, source = rooms.seen(place, first, size, fov=0.7)
    second = first @ rooms.pose(0.02, 0.01, np.array([0.03, 0.01, 0.02]))
    reference, own, target = rooms.seen(place, second, size, fov=0.7)
    arrays = [jnp.asarray(x, float) for x in (1.2 * reference, own, image, depth)]
    views = _pose_residual.Views(*arrays, source, target)
    clear = _pose_residual.clear_of_steps(views.depth, 0.1)
    # With this scale no difference is beyond the corner of Huber's loss.
    model = _pose_residual.Residual(
        views, clear, jnp.ones(6), jnp.ones(2), hole_threshold=0.1, exposure=True, stride=1
    )
    twist = jnp.asarray(np.random.default_rng(0).normal(size=6) * 1e-3)
    _, columns, (_, found) = linear(model, twist)
    assert float(found.counts.mean()) > 0.3
    residual = eqx.filter_jit(lambda twist: model(twist)[0])
    step = 1e-6
    for i, along in enumerate(np.eye(6)):
        ends = [residual(twist + sign * step * along) for sign in (1, -1)]
        quotient = np.asarray(ends[0] - ends[1]).reshape(-1) / (2 * step)
        differs = np.abs(quotient - columns[:, i]) > 1e-4 * np.abs(columns[:, i]).max()
        # A ray that goes from one texel to the next changes the surface that it reads.
        assert differs.mean() < 0.01
    weight = jnp.asarray(np.random.default_rng(1).normal(size=(*size, 4)))
    pulled = jax.jit(lambda twist: jax.vjp(residual, twist)[1](weight)[0])(twist)
    np.testing.assert_allclose(pulled, weight.reshape(-1) @ columns, rtol=1e-7)


@pytest.mark.full
def test_depth_of_its_own_makes_the_pose_surer():
    reference, image, depth, source, own, true = taken(3, 0.15, np.array([0.1, 0.02, 0.05]))
    own = own.copy()
    own[20:30, 30:40] = 0  # Missing depth does not count.
    plain = fit.camera(reference, image, depth, source, source)
    found = fit.camera(reference, image, depth, source, source, reference_depth=own)
    angle, distance = apart(found.camera, true)
    assert found.wander < 0.5 * plain.wander
    assert angle < 0.05 and np.linalg.norm(distance) < 0.003


@pytest.mark.full
def test_exposure_is_found_or_held():
    reference, image, depth, source, _, true = taken(5, 0.1, np.array([0.05, 0, 0]), noise=0)
    tint, glare = np.array([1.3, 0.8, 0.6], np.float32), np.array([0, 0.1, 0.2], np.float32)
    pair = image, depth, source, source
    found = fit.camera(tint * reference + glare, *pair)
    scale = np.asarray(fit.camera(reference, *pair).gain)
    np.testing.assert_allclose(found.gain, tint * scale, rtol=0.01)
    assert apart(found.camera, true)[0] < 0.1
    held = fit.camera(tint * reference + glare, *pair, exposure="equal", throw=False)
    np.testing.assert_array_equal(held.gain, 1)
    assert apart(held.camera, true)[0] > 0.1


@pytest.mark.full
def test_a_light_of_forty_times_white_does_not_decide_and_other_outliers_are_admitted():
    reference, image, depth, source, _, true = taken(7, 0.1, np.array([0.05, 0, 0.05]))
    lamp = reference.copy()
    lamp[20:24, 30:34] = 20
    found = fit.camera(lamp, image, depth, source, source)
    angle, distance = apart(found.camera, true)
    assert angle < 0.1 and np.linalg.norm(distance) < 0.005
    reference[10:36, 50:76] = np.random.default_rng(0).uniform(size=3)  # A tenth of it.
    found = fit.camera(reference, image, depth, source, source, throw=False)
    angle, distance = apart(found.camera, true)
    assert np.deg2rad(angle) < 3 * np.linalg.norm(found.standard_errors["rotation"])
    assert np.linalg.norm(distance) < 3 * np.linalg.norm(found.standard_errors["translation"])


@pytest.mark.full
def test_large_images_are_found_on_small_ones_first():
    reference, image, depth, source, _, true = taken(
        9, 0.12, np.array([0.1, 0, 0.05]), (241, 322)
    )
    found = fit.camera(reference, image, depth, source, source)
    angle, distance = apart(found.camera, true)
    assert angle < 0.05 and np.linalg.norm(distance) < 0.003


@pytest.mark.full
def test_no_texture_is_no_success():
    _, image, depth, source, _, _ = taken(11, 0.1, np.zeros(3), noise=0)
    grain = np.random.default_rng(0).normal(size=(2, *image.shape)) * 0.01
    even = (0.5 + grain).astype(np.float32)
    assert not fit.camera(*even, depth, source, source, throw=False).success
    with pytest.raises(RuntimeError, match="`camera` found no pose"):
        fit.camera(*even, depth, source, source)
