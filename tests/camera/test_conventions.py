"""Each program's own formula, written out, against the camera made from its numbers."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfx import PinholeCamera


HEIGHT, WIDTH = 48, 64


def rotation(seed):
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes * np.linalg.det(axes)


ROTATION, TRANSLATION = rotation(1), np.array([0.3, -0.2, 5.0])
POINTS = np.random.default_rng(2).uniform(-1, 1, (20, 3))
INTRINSICS = np.array([[70.0, 0.4, 31.0], [0, 75.0, 22.0], [0, 0, 1]])


def assert_sees(camera, pixels, depth, points=POINTS):
    found, found_depth = camera.project(points)
    np.testing.assert_allclose(found, pixels, rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(found_depth, depth, rtol=1e-12)


def test_opencv():
    """`projectPoints` without distortion: pixel (0, 0) has its centre at (0, 0)."""
    local = POINTS @ ROTATION.T + TRANSLATION
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    u = INTRINSICS[0, 0] * x + INTRINSICS[0, 1] * y + INTRINSICS[0, 2]
    v = INTRINSICS[1, 1] * y + INTRINSICS[1, 2]
    camera = PinholeCamera.from_opencv(INTRINSICS, rotation=ROTATION, translation=TRANSLATION)
    # Its pixel (i, j) is the one of column i and row j here, whose centre is half a pixel on.
    assert_sees(camera, np.stack([u, v], axis=1) + 0.5, local[:, 2])
    plain = PinholeCamera.from_opencv(INTRINSICS)
    np.testing.assert_array_equal(plain.world_from_camera, np.eye(4))


def test_opencv_against_the_library():
    cv2 = pytest.importorskip("cv2", reason="OpenCV comes with the extra `bench`")
    pixels, _ = cv2.projectPoints(
        POINTS,
        cv2.Rodrigues(ROTATION)[0],
        TRANSLATION,
        np.triu(INTRINSICS * (1 - np.eye(3, k=1))),
        None,
    )
    matrix = INTRINSICS * (1 - np.eye(3, k=1))
    camera = PinholeCamera.from_opencv(matrix, rotation=ROTATION, translation=TRANSLATION)
    np.testing.assert_allclose(camera.project(POINTS)[0], pixels[:, 0] + 0.5, rtol=1e-9)


def quaternion(turn):
    """Of a rotation, (w, x, y, z): the eigenvector of Bar-Itzhack's matrix."""
    spin = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    matrix = np.block(
        [
            [turn + turn.T - np.trace(turn) * np.eye(3), spin[:, None]],
            [spin[None], np.trace(turn)],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    return np.array([w, x, y, z])


@pytest.mark.parametrize(
    ("model", "params"), [("SIMPLE_PINHOLE", [70, 31, 22]), ("PINHOLE", [70, 75, 31, 22])]
)
@pytest.mark.parametrize("length", [1.0, -0.3])
def test_colmap(model, params, length):
    """`images.txt` and `cameras.txt`: the centre of the upper left pixel is (0.5, 0.5)."""
    local = POINTS @ ROTATION.T + TRANSLATION
    focal, centre = np.array([params[0], params[-3]]), np.array(params[-2:])
    pixels = focal * local[:, :2] / local[:, 2:] + centre
    qvec = length * quaternion(ROTATION)
    camera = PinholeCamera.from_colmap(model, params, qvec=qvec, tvec=TRANSLATION)
    assert_sees(camera, pixels, local[:, 2])


def matrix_world(scale=1.0):
    """The pose of a camera that looks along -z with y up, and the points in its axes."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(3)
    pose[:3, 3] = [1, -2, 0.5]
    local = np.random.default_rng(4).uniform([-1, -1, -6], [1, 1, -3], (20, 3))
    world = local @ pose[:3, :3].T + pose[:3, 3]
    pose[:3, :3] *= scale
    return pose, local, world


def blender_pixels(local, lens, sensor, fit, shift, size):
    """Blender's view plane at distance `lens`, whose window is what the render shows."""
    height, width = size
    side = width if fit == "HORIZONTAL" or (fit == "AUTO" and width >= height) else height
    unit = (sensor[1] if fit == "VERTICAL" else sensor[0]) / side
    left = (-width / 2 + shift[0] * side) * unit
    bottom = (-height / 2 + shift[1] * side) * unit
    x, y = (lens * local[:, i] / -local[:, 2] for i in (0, 1))
    from_below = (y - bottom) / unit
    return np.stack([(x - left) / unit, height - from_below], axis=1)


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(48, 64), (64, 48)])
@pytest.mark.parametrize("shift", [(0, 0), (0.1, -0.2)])
def test_blender(fit, size, shift):
    pose, local, world = matrix_world(scale=2.5)
    pixels = blender_pixels(local, 50.0, (36.0, 20.0), fit, shift, size)
    camera = PinholeCamera.from_blender(
        pose,
        **{"lens": 50, "sensor_width": 36, "sensor_height": 20, "sensor_fit": fit},
        **{"shift_x": shift[0], "shift_y": shift[1], "height": size[0], "width": size[1]},
    )
    assert_sees(camera, pixels, -local[:, 2], world)


def test_blender_as_it_comes():
    """A field of view of 2 atan(36 / 2 / 50) along rows, without rotation."""
    camera = PinholeCamera.from_blender(np.eye(4), lens=50, height=HEIGHT, width=WIDTH)
    edge = 18 / 50
    pixels, _ = camera.project(np.array([[edge, 0, -1], [0, edge, -1]]))
    np.testing.assert_allclose(
        pixels, [[WIDTH, HEIGHT / 2], [WIDTH / 2, HEIGHT / 2 - WIDTH / 2]]
    )


def test_nerf():
    """NeRF's code: `focal = 0.5 * w / tan(0.5 * camera_angle_x)`, rays along -z."""
    pose, local, world = matrix_world()
    angle = 0.69
    focal = 0.5 * WIDTH / np.tan(0.5 * angle)
    x = WIDTH / 2 + focal * local[:, 0] / -local[:, 2]
    y = HEIGHT / 2 - focal * local[:, 1] / -local[:, 2]
    pixels, size = np.stack([x, y], axis=1), {"height": HEIGHT, "width": WIDTH}
    camera = PinholeCamera.from_nerf(pose, camera_angle_x=angle, **size)
    assert_sees(camera, pixels, -local[:, 2], world)
    same = PinholeCamera.from_nerf(pose, fl_x=focal, **size)
    assert_sees(same, pixels, -local[:, 2], world)
    # The ray of pixel (i, j) is ((i + 0.5 - w / 2) / f, -(j + 0.5 - h / 2) / f, -1).
    j, i = np.indices((HEIGHT, WIDTH))
    rays = np.stack(
        [(i + 0.5 - WIDTH / 2) / focal, -(j + 0.5 - HEIGHT / 2) / focal, -np.ones(i.shape)], -1
    )
    rays = rays @ pose[:3, :3].T
    origins, directions = camera.rays(**size)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(directions, unit, atol=1e-12)
    np.testing.assert_array_equal(origins[3, 5], pose[:3, 3])
    moved = PinholeCamera.from_nerf(pose, fl_x=60, fl_y=61, cx=30.0, cy=20.5, **size)
    x, y = 30 + 60 * local[:, 0] / -local[:, 2], 20.5 - 61 * local[:, 1] / -local[:, 2]
    assert_sees(moved, np.stack([x, y], axis=1), -local[:, 2], world)
    # Pixels that are not square, beside an angle.
    tall = PinholeCamera.from_nerf(pose, camera_angle_x=angle, fl_y=61, **size)
    y = HEIGHT / 2 - 61 * local[:, 1] / -local[:, 2]
    assert_sees(tall, np.stack([pixels[:, 0], y], axis=1), -local[:, 2], world)


def frustum(left, right, bottom, top, near, far):
    """`glFrustum`'s matrix."""
    return np.array(
        [
            [2 * near / (right - left), 0, (right + left) / (right - left), 0],
            [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )


def test_opengl():
    """Clip space, division by w, viewport: (x + 1) / 2 of the width, rows from the bottom."""
    pose, local, world = matrix_world()
    projection = frustum(-0.06, 0.09, -0.05, 0.07, 0.1, 100.0)
    projection[0, 1] = 0.02  # a skew
    clip = np.concatenate([local, np.ones((20, 1))], axis=1) @ projection.T
    ndc = clip[:, :2] / clip[:, 3:]
    x, from_below = (ndc[:, 0] + 1) / 2 * WIDTH, (ndc[:, 1] + 1) / 2 * HEIGHT
    view = np.linalg.inv(pose)
    camera = PinholeCamera.from_opengl(view, projection, height=HEIGHT, width=WIDTH)
    assert_sees(camera, np.stack([x, HEIGHT - from_below], axis=1), clip[:, 3], world)


@pytest.mark.full
def test_gradients():
    pose, _, _ = matrix_world()
    size = {"height": HEIGHT, "width": WIDTH}
    made = {
        "opencv": lambda k, r, t: PinholeCamera.from_opencv(k, rotation=r, translation=t),
        "colmap": lambda p, q, t: PinholeCamera.from_colmap("PINHOLE", p, qvec=q, tvec=t),
        "blender": lambda m, f, s: PinholeCamera.from_blender(m, lens=f, shift_x=s, **size),
        "nerf": lambda m, a, c: PinholeCamera.from_nerf(m, camera_angle_x=a, cx=c, **size),
        "opengl": lambda v, p, _: PinholeCamera.from_opengl(v, p, **size),
    }
    given = {
        "opencv": (INTRINSICS, ROTATION, TRANSLATION),
        "colmap": (np.array([70.0, 75, 31, 22]), quaternion(ROTATION), TRANSLATION),
        "blender": (pose, np.array(50.0), np.array(0.1)),
        "nerf": (pose, np.array(0.7), np.array(30.0)),
        "opengl": (
            np.linalg.inv(pose),
            frustum(-0.06, 0.09, -0.05, 0.07, 0.1, 9.0),
            np.array(0.0),
        ),
    }
    for name, make in made.items():
        project = jax.jit(lambda *x, make=make: make(*x).project(jnp.asarray(POINTS))[0])
        arguments = tuple(map(jnp.asarray, given[name]))
        check_grads(project, arguments, order=1, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "arguments", "options", "message"),
    [
        ("from_opencv", (np.eye(4),), {}, r"`from_opencv\(intrinsics\)` must have shape"),
        ("from_opencv", (INTRINSICS,), {"rotation": 2 * np.eye(3)}, "must be a rotation and a"),
        (
            "from_colmap",
            ("RADIAL", [1, 2, 3, 0, 0]),
            {"qvec": [1, 0, 0, 0], "tvec": [0, 0, 0]},
            r"`from_colmap\(model\)` must be one of .*'PINHOLE'\), got 'RADIAL'",
        ),
        (
            "from_colmap",
            ("PINHOLE", [1, 2, 3]),
            {"qvec": [1, 0, 0, 0], "tvec": [0, 0, 0]},
            r"`from_colmap\(params\)` must be fx, fy, cx, cy, got shape \(3,\)",
        ),
        (
            "from_colmap",
            ("PINHOLE", [1, 2, 3, 4]),
            {"qvec": [0, 0, 0, 0], "tvec": [0, 0, 0]},
            r"`from_colmap\(qvec=...\)` must be a rotation's quaternion",
        ),
        (
            "from_blender",
            (np.eye(4),),
            {"lens": 0, "height": 4, "width": 4},
            r"`from_blender\(lens=...\)` must be positive, got 0",
        ),
        (
            "from_blender",
            (np.eye(4),),
            {"lens": 50, "height": 4, "width": 4, "sensor_fit": "FILL"},
            r"`from_blender\(sensor_fit=...\)` must be one of",
        ),
        (
            "from_nerf",
            (np.eye(4),),
            {"height": 4, "width": 4},
            r"`from_nerf\(camera_angle_x=..., fl_x=...\)` must be given one of the two",
        ),
        (
            "from_nerf",
            (np.eye(4),),
            {"height": 4, "width": True, "fl_x": 3},
            r"`from_nerf\(width=...\)` must be a positive integer, got True",
        ),
        (
            "from_opengl",
            (np.eye(4), np.eye(4)),
            {"height": 4, "width": 4},
            r"`from_opengl\(projection\)` must be a perspective projection",
        ),
        (
            "from_opengl",
            (np.eye(4), frustum(-1, 1, -1, 1, 1, 9).T),
            {"height": 4, "width": 4},
            r"`from_opengl\(projection\)` must be a perspective projection",
        ),
    ],
)
def test_errors(name, arguments, options, message):
    make = inspect.unwrap(getattr(PinholeCamera, name).__func__)
    with pytest.raises(ValueError, match=message):
        make(PinholeCamera, *arguments, **options)
