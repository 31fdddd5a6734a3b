"""Cameras against homogeneous coordinates, written out, and finite differences."""

import inspect

import equinox as eqx
import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfx import OrthographicCamera, PinholeCamera
from tests.helpers.forms import first


def rigid(rng):
    """A random pose: a right-handed rotation and a translation."""
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = axes * np.linalg.det(axes)
    pose[:3, 3] = rng.normal(size=3)
    return pose


def pinhole(rng):
    """Intrinsics with oblong pixels, a skew and an off-centre principal point."""
    intrinsics = [
        [rng.uniform(40, 90), rng.normal(), 31],
        [0, rng.uniform(40, 90), 23],
        [0, 0, 1],
    ]
    return PinholeCamera(np.array(intrinsics), rigid(rng))


def orthographic(rng):
    return OrthographicCamera(rng.uniform(5, 20), rng.normal(size=2), rigid(rng))


CAMERAS = [pinhole, orthographic]


def points_before(camera, rng, count):
    """World points in front of the camera."""
    local = rng.uniform([-1, -1, 1.5], [1, 1, 6], (count, 3))
    pose = np.asarray(camera.world_from_camera)
    return local @ pose[:3, :3].T + pose[:3, 3]


# Compiled once for many examples.
@jax.jit
def project(camera, points):
    return camera.project(points)


@jax.jit
def unproject(camera, pixels, depth):
    return camera.unproject(pixels, depth)


@jax.jit
def look_at_from(eye, target, up, fov_y):
    return PinholeCamera.look_at(eye, target, up=up, fov_y=fov_y, height=40, width=70)


@jax.jit
def through_lens(camera, offset, distance):
    return camera.through_lens(offset, focus_distance=distance)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_pinhole_project_in_homogeneous_coordinates(rng):
    camera = pinhole(rng)
    points = points_before(camera, rng, 20)
    pixels, depth = map(np.asarray, camera.project(points))
    for point, pixel, z in zip(points, pixels, depth, strict=True):
        local = np.linalg.inv(camera.world_from_camera) @ np.append(point, 1)
        image = np.asarray(camera.intrinsics) @ local[:3]
        np.testing.assert_allclose(pixel, image[:2] / image[2], rtol=1e-12)
        np.testing.assert_allclose(z, local[2], rtol=1e-12)


def test_orthographic_project_in_homogeneous_coordinates(rng):
    camera = orthographic(rng)
    points = rng.normal(size=(20, 3))
    pixels, depth = map(np.asarray, camera.project(points))
    for point, pixel, z in zip(points, pixels, depth, strict=True):
        local = np.linalg.inv(camera.world_from_camera) @ np.append(point, 1)
        expected = local[:2] * float(camera.pixels_per_unit) + np.asarray(camera.center)
        np.testing.assert_allclose(pixel, expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(z, local[2], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("make", CAMERAS)
@hyp.given(st.integers(0, 2**32))
@hyp.settings(max_examples=20, deadline=None)
def test_unproject_is_the_inverse_of_project(make, seed):
    rng = np.random.default_rng(seed)
    camera = make(rng)
    points = points_before(camera, rng, 6).reshape(2, 3, 3)
    pixels, depth = map(np.asarray, project(camera, points))
    assert pixels.shape == (2, 3, 2)
    assert depth.shape == (2, 3)
    np.testing.assert_allclose(unproject(camera, pixels, depth), points, rtol=0, atol=1e-12)
    again, _ = project(camera, unproject(camera, pixels + 1, depth))
    np.testing.assert_allclose(again, pixels + 1, rtol=0, atol=1e-10)


@pytest.mark.parametrize("make", CAMERAS)
def test_float32_points(rng, make):
    camera = make(rng)
    points = points_before(camera, rng, 50)
    pixels, depth = camera.project(points)
    single_pixels, single_depth = camera.project(points.astype(np.float32))
    assert single_pixels.dtype == single_depth.dtype == jnp.float32
    np.testing.assert_allclose(single_pixels, pixels, rtol=0, atol=2e-4)
    np.testing.assert_allclose(single_depth, depth, rtol=0, atol=2e-6)
    back = camera.unproject(single_pixels, single_depth)
    assert back.dtype == jnp.float32
    np.testing.assert_allclose(back, points, rtol=0, atol=2e-5)


def test_behind_the_camera_and_at_infinity():
    camera = PinholeCamera.from_fov(np.pi / 2, height=4, width=6)
    pixels, depth = camera.project(np.array([1.0, 0, -2]))
    np.testing.assert_allclose(depth, -2)
    np.testing.assert_allclose(pixels, [2, 2])
    assert not np.any(np.isfinite(camera.unproject(np.array([1.0, 1]), np.array(np.inf))))


@pytest.mark.parametrize("fov_y", [0.2, 0.8, 2.5])
def test_from_fov(fov_y):
    camera = PinholeCamera.from_fov(fov_y, height=40, width=70)
    slope = np.tan(fov_y / 2)
    points = [[0, 0, 3], [0, -3 * slope, 3], [0, 3 * slope, 3], [3 * slope, 0, 3]]
    pixels, depth = camera.project(np.array(points))
    np.testing.assert_allclose(pixels, [[35, 20], [35, 0], [35, 40], [55, 20]], atol=1e-12)
    np.testing.assert_allclose(depth, 3)
    np.testing.assert_array_equal(camera.world_from_camera, np.eye(4))
    pose = rigid(np.random.default_rng(0))
    moved = PinholeCamera.from_fov(fov_y, height=40, width=70, world_from_camera=pose)
    np.testing.assert_array_equal(moved.world_from_camera, pose)


@hyp.given(st.integers(0, 2**32))
@hyp.settings(max_examples=20, deadline=None)
def test_look_at(seed):
    rng = np.random.default_rng(seed)
    eye, target, up = rng.normal(size=(3, 3)) * rng.uniform(0.1, 10, (3, 1))
    camera = look_at_from(eye, target, up, 0.7)
    pixel, depth = project(camera, target)
    np.testing.assert_allclose(pixel, [35, 20], atol=1e-9)
    np.testing.assert_allclose(depth, np.linalg.norm(target - eye), rtol=1e-12)
    pose = np.asarray(camera.world_from_camera)
    axes = pose[:3, :3]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1, rtol=1e-12)
    np.testing.assert_array_equal(pose[:3, 3], eye)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    # Up is up in the image, and right is right.
    x, y = np.asarray(project(camera, target + 1e-3 * up)[0])
    assert y < 20
    np.testing.assert_allclose(x, 35, atol=1e-9)
    x, y = np.asarray(project(camera, target + 1e-3 * np.cross(target - eye, up))[0])
    assert x > 35
    np.testing.assert_allclose(y, 20, atol=1e-9)


def test_look_at_has_a_finite_gradient_where_the_pose_is_degenerate():
    def pose(eye):
        camera = PinholeCamera.look_at(
            eye, (0.0, 0, 0), up=(0.0, 1, 0), fov_y=1, height=2, width=2
        )
        return camera.world_from_camera[:3, :3]

    jacobians = jax.jit(lambda eye: (jax.jacfwd(pose)(eye), jax.jacrev(pose)(eye)))
    for eye in ([0.0, 0, 0], [0.0, 2, 0]):
        forward, reverse = jacobians(np.array(eye))
        assert np.isfinite(forward).all()
        assert np.isfinite(reverse).all()
    np.testing.assert_array_equal(jacobians(np.zeros(3))[1], 0)


@hyp.given(st.integers(0, 2**32))
@hyp.settings(max_examples=20, deadline=None)
def test_through_lens(seed):
    """Points in focus keep their pixel; others move by offset * f * (1 / Zf - 1 / Z)."""
    rng = np.random.default_rng(seed)
    camera = pinhole(rng)
    offset, distance = rng.normal(size=2), rng.uniform(1, 5)
    moved = through_lens(camera, offset, distance)
    pixels = rng.uniform(0, 60, (30, 2))
    depths = rng.uniform(0.5, 9, 30)

    still, depth = project(moved, unproject(camera, pixels, np.full(30, distance)))
    np.testing.assert_allclose(still, pixels, rtol=0, atol=1e-11)
    np.testing.assert_allclose(depth, distance, rtol=1e-12)

    shifted, depth = project(moved, unproject(camera, pixels, depths))
    focal = np.asarray(camera.intrinsics)[:2, :2]
    expected = (focal @ offset) * (1 / distance - 1 / depths)[:, None]
    np.testing.assert_allclose(np.asarray(shifted) - pixels, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(depth, depths, rtol=1e-12)


def test_through_the_centre_of_the_lens_is_the_camera_itself(rng):
    camera = pinhole(rng)
    moved = camera.through_lens((0, 0), focus_distance=2)
    assert eqx.tree_equal(jax.device_get(moved), jax.device_get(camera))


def test_the_focus_plane_stays_within_1e_12():
    camera = PinholeCamera.from_fov(0.9, height=32, width=48)
    y, x = np.mgrid[:32, :48] + 0.5
    pixels = np.stack([x, y], axis=-1)
    moved = camera.through_lens((0.05, -0.03), focus_distance=2.0)
    still, _ = moved.project(camera.unproject(pixels, np.full((32, 48), 2.0)))
    np.testing.assert_allclose(still, pixels, rtol=0, atol=1e-12)


@first("make", CAMERAS)
def test_gradients_of_project_and_unproject(rng, make):
    """Derivatives in every field, the points, the pixels and the depth, in both modes."""
    camera = jax.device_get(make(rng))  # `check_grads` adds steps: by NumPy, nothing compiles.
    points = points_before(camera, rng, 3)
    pixels, depth = jax.device_get(project(camera, points))
    check_grads(project, (camera, points), order=1, rtol=1e-6, eps=1e-5)
    check_grads(unproject, (camera, pixels, depth), order=1, rtol=1e-6, eps=1e-5)


def test_gradients_of_constructors(rng):
    check_grads(look_at_from, (*rng.normal(size=(3, 3)), 0.7), order=1, rtol=1e-6, eps=1e-5)
    camera = jax.device_get(pinhole(rng))
    check_grads(through_lens, (camera, rng.normal(size=2), 2.3), order=1, rtol=1e-6)


@pytest.mark.parametrize("make", CAMERAS)
def test_a_batch_of_cameras(rng, make):
    cameras = [make(rng) for _ in range(3)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *cameras)
    points = rng.uniform(1, 2, (3, 5, 3))
    pixels, depth = map(np.asarray, jax.vmap(project)(batch, points))
    for i, camera in enumerate(cameras):
        expected_pixels, expected_depth = camera.project(points[i])
        np.testing.assert_allclose(pixels[i], expected_pixels, rtol=1e-11)
        np.testing.assert_allclose(depth[i], expected_depth, rtol=1e-11)


@first("make", CAMERAS)
def test_rays_and_points(rng, make):
    camera, size = make(rng), (3, 5)
    origins, directions = map(np.asarray, camera.rays(height=np.int64(3), width=5))
    assert origins.shape == directions.shape == (*size, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, rtol=1e-14)
    # A point on a ray projects to the centre of its pixel.
    pixels, depth = camera.project(origins + 2.5 * directions)
    y, x = np.indices(size)
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1) + 0.5, rtol=1e-10)
    assert (np.asarray(depth) > 0).all()
    if make is pinhole:
        eye = np.asarray(camera.world_from_camera)[:3, 3]
        np.testing.assert_array_equal(origins, np.broadcast_to(eye, (*size, 3)))
    else:
        np.testing.assert_allclose(camera.project(origins)[1], 0, atol=1e-12)

    depth = rng.uniform(1, 3, size)
    points = camera.points(depth)
    np.testing.assert_allclose(camera.project(points)[0], pixels, rtol=1e-10)
    np.testing.assert_allclose(camera.project(points)[1], depth, rtol=1e-12)
    # They lie on the rays.
    along = np.asarray(points) - origins
    np.testing.assert_allclose(np.cross(along, directions), 0, atol=1e-10)
    points_of = jax.jit(lambda camera, depth: camera.points(depth))
    camera = jax.device_get(camera)
    check_grads(points_of, (camera, depth), order=1, rtol=1e-4)
    rays_of = jax.jit(lambda camera: camera.rays(height=3, width=5))
    check_grads(rays_of, (camera,), order=1, rtol=1e-4)


@first("make", CAMERAS)
def test_types_of_what_is_given(rng, make):
    """Integers and lists are accepted; float16 is computed in float32."""
    camera = make(rng)
    points = np.array([[1, 2, -3], [4, 0, 5]])
    expected = camera.project(points.astype(float))
    for given in (points, points.tolist(), points.astype(np.int16), points.astype(">i8")):
        for one, other in zip(camera.project(given), expected, strict=True):
            assert one.dtype == jnp.float64
            np.testing.assert_array_equal(one, other)
    pixels, depth = np.array([[320, 100], [7, 9]]), np.array([2, 3], np.uint16)
    expected = camera.unproject(pixels.astype(float), depth.astype(float))
    for given in ((pixels, depth), (pixels.tolist(), depth.tolist()), (pixels, depth * 1.0)):
        np.testing.assert_array_equal(camera.unproject(*given), expected)
    for one, other in ((pixels, 2), (pixels[0], depth)):
        broadcast = np.broadcast_to(one, (2, 2)), np.broadcast_to(other, 2)
        np.testing.assert_array_equal(
            camera.unproject(one, other), camera.unproject(*broadcast)
        )
    image = np.array([[1, 2, 3], [4, 5, 6]], np.uint16)
    np.testing.assert_array_equal(camera.points(image), camera.points(image * 1.0))

    half = camera.unproject(pixels.astype(np.float16), np.float16([300, 400]))
    assert half.dtype == jnp.float16
    exact = camera.unproject(pixels.astype(float), np.array([300.0, 400.0]))
    np.testing.assert_allclose(np.float64(half), exact, rtol=2e-3)
    mixed = camera.unproject(pixels.astype(np.float32), np.array([300.0, 400.0]))
    assert mixed.dtype == jnp.float64
    np.testing.assert_allclose(mixed, exact, rtol=1e-14)


def bad_poses():
    pose = rigid(np.random.default_rng(3))
    turned = lambda matrix: (
        pose @ np.block([[np.array(matrix), np.zeros((3, 1))], [np.zeros((1, 3)), 1]])
    )
    row = pose.copy()
    row[3] = [0, 0, 1, 1]
    moved = pose.copy()
    moved[0, 3] = np.nan
    return {
        "scale": turned(2 * np.eye(3)),
        "slight scale": turned(1.01 * np.eye(3)),
        "shear": turned([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
        "mirror": turned(np.diag([1, 1, -1])),
        "zero": np.zeros((4, 4)),
        "last row": row,
        "nowhere": moved,
        "transposed": rigid(np.random.default_rng(4)).T,
    }


BY_POSE = {
    "PinholeCamera": lambda p: PinholeCamera(np.eye(3), p),
    "OrthographicCamera": lambda p: OrthographicCamera(1, [0, 0], p),
}


@pytest.mark.parametrize("kind", bad_poses())
def test_poses_that_are_not_rigid(kind):
    pose = bad_poses()[kind]
    for name, make in BY_POSE.items():
        message = rf"`{name}\(world_from_camera\)` must be a rotation and a finite position"
        with pytest.raises(ValueError, match=message):
            make(pose)
        assert jax.jit(make)(pose) is not None  # A traced one can't be looked at.
        # Poses rounded by a file or by float16 count as rigid.
        make(np.round(rigid(np.random.default_rng(5)), 4))
        make(rigid(np.random.default_rng(5)).astype(np.float16))


@pytest.mark.parametrize(
    "intrinsics",
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
        [[1, 0, 0], [0, 1, 0], [0.1, 0, 1]],
        [[np.nan, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, np.inf], [0, 1, 0], [0, 0, 1]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    ],
)
def test_intrinsics_that_are_none(intrinsics):
    message = r"`PinholeCamera\(intrinsics\)` must be finite, with positive focal lengths and"
    with pytest.raises(ValueError, match=message):
        PinholeCamera(intrinsics, np.eye(4))


@first("make", CAMERAS)
def test_a_batch_of_cameras_without_vmap(rng, make):
    each = make(rng), make(rng), make(rng)
    cameras = jax.tree.map(lambda *x: np.stack(x), *each)
    calls = {
        "project": lambda camera: camera.project(np.ones(3)),
        "unproject": lambda camera: camera.unproject(np.ones(2), 1.0),
        "rays": lambda camera: camera.rays(height=2, width=3),
        "points": lambda camera: camera.points(np.ones((2, 3))),
    }
    for method, call in calls.items():
        with pytest.raises(
            ValueError,
            match=r"must be one \w+Camera, whose .* Batches are made with `jax.vmap`",
        ):
            call(cameras)
        batch = np.asarray(jax.tree.leaves(jax.jit(jax.vmap(call))(cameras))[0])
        one = jax.tree.leaves(call(each[0]))[0]
        np.testing.assert_allclose(batch[0], one, rtol=1e-12, err_msg=method)


def test_fields_are_strongly_typed():
    camera = OrthographicCamera(2, (1, 2), np.eye(4, dtype=int))
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(camera))
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(camera))
    single = PinholeCamera(np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(single))


def look_at(eye=(0.0, 0, 0), at=(0.0, 0, 1), up=(0.0, 1, 0), fov_y=1.0):
    return PinholeCamera.look_at(eye, at, up=up, fov_y=fov_y, height=2, width=2)


def bad_lens(offset=(0.0, 0), distance=1.0):
    bare = inspect.unwrap(PinholeCamera.through_lens)
    return bare(look_at(), offset, focus_distance=distance)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: PinholeCamera(np.eye(4), np.eye(4)),
            r"`PinholeCamera\(intrinsics\)` .*\(3, 3\)",
        ),
        (lambda: PinholeCamera(np.eye(3), np.eye(3)), r"`PinholeCamera\(world_from_camera\)`"),
        (lambda: look_at(fov_y=0), r"`from_fov\(fov_y\)` must be in \(0, pi\) radians, got 0"),
        (lambda: look_at(fov_y=np.pi), r"`from_fov\(fov_y\)` must be in"),
        (lambda: look_at(at=(0.0, 0, 0)), r"`look_at\(at\)` must be away from `eye`"),
        (lambda: look_at(up=(0.0, 0, 3)), r"`look_at\(up=...\)` must be off the direction"),
        (lambda: look_at(eye=(0.0, 0)), r"`look_at\(eye\)` must have shape \(3,\), got \(2,\)"),
        (
            lambda: bad_lens(offset=(0.0,)),
            r"`through_lens\(offset\)` must have shape \(2,\)",
        ),
        (
            lambda: bad_lens(distance=0),
            r"`through_lens\(focus_distance=...\)` must be posit",
        ),
        (
            lambda: OrthographicCamera(0, (0, 0), np.eye(4)),
            r"`OrthographicCamera\(pixels_per_unit\)` must be positive, got 0",
        ),
        (lambda: OrthographicCamera(1, 0, np.eye(4)), r"`OrthographicCamera\(center\)` must"),
        (
            lambda: OrthographicCamera(1, (0, 0), np.eye(4)[:3]),
            r"`OrthographicCamera\(world_from_camera\)` must have shape \(4, 4\)",
        ),
    ],
)
def test_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()
