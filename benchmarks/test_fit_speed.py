"""Poses of RGB-D pairs against Open3D and OpenCV, in one run: time, and how far off each is.

`pytest --benchmark-only -s benchmarks/test_fit_speed.py` prints the medians over rooms. The
peers come with the extra `bench`; one that is not installed is left out. They take both depths
and grey images of 8 bits.
"""

import functools
import importlib.util

import jax
import numpy as np
import pytest

from benchmarks.turns import in_turns
from jaxfx import fit
from tests.cases import rooms


SIZE = (480, 640)


@functools.cache
def pair(seed):
    """Two images of a room, their depths and cameras: 2 to 9 degrees, 4 to 14 cm apart."""
    rng = np.random.default_rng(seed)
    first = rooms.pose(rng.uniform(-3, 3), 0, rng.uniform(-0.3, 0.3, 3))
    shift = rng.normal(size=3)
    shift *= rng.uniform(0.04, 0.14) / np.linalg.norm(shift)
    turn = rng.uniform(0.03, 0.15) * rng.choice([-1, 1])
    place, second = rooms.room(seed), first @ rooms.pose(turn, 0.02, shift)
    return rooms.seen(place, first, SIZE), rooms.seen(place, second, SIZE)


def ours(seed, brightness, with_depth):
    (image, depth, source), (reference, own, target) = pair(seed)
    options = {"reference_depth": own} if with_depth else {}
    start = type(target)(target.intrinsics, source.world_from_camera)
    found = fit.camera(brightness * reference, image, depth, source, start, **options)
    return np.asarray(jax.block_until_ready(found.camera.world_from_camera))


def grey(image, brightness=1.0):
    return np.rint(255 * np.clip(brightness * image.mean(axis=-1), 0, 1)).astype(np.uint8)


def open3d(seed, brightness):
    import open3d

    (image, depth, source), (reference, own, _) = pair(seed)
    make = functools.partial(
        open3d.geometry.RGBDImage.create_from_color_and_depth,
        depth_scale=1.0,
        depth_trunc=100.0,
        convert_rgb_to_intensity=True,
    )
    frames = [
        make(open3d.geometry.Image(np.repeat(c[..., None], 3, -1)), open3d.geometry.Image(d))
        for c, d in ((grey(reference, brightness), own), (grey(image), depth))
    ]
    k = np.asarray(source.intrinsics, float)
    middle = k[:2, 2] - 0.5  # Its pixels' centres are whole numbers.
    lens = open3d.camera.PinholeCameraIntrinsic(*SIZE[::-1], k[0, 0], k[1, 1], *middle)
    _, moved, _ = open3d.pipelines.odometry.compute_rgbd_odometry(
        *frames,
        lens,
        np.eye(4),
        open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
        open3d.pipelines.odometry.OdometryOption(),
    )
    return np.asarray(source.world_from_camera, float) @ moved


def opencv(seed, brightness):
    import cv2

    (image, depth, source), (reference, own, _) = pair(seed)
    settings = cv2.OdometrySettings()
    k = np.array(source.intrinsics, np.float32)
    k[:2, 2] -= 0.5  # Its pixels' centres are whole numbers.
    settings.setCameraMatrix(k)
    settings.setMaxDepth(100.0)
    search = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    frames = [
        cv2.OdometryFrame(d, np.repeat(c[..., None], 3, -1))
        for c, d in ((grey(reference, brightness), own), (grey(image), depth))
    ]
    search.prepareFrames(*frames)
    _, moved = search.compute(*frames)
    return np.asarray(source.world_from_camera, float) @ moved


def off(found, seed):
    """Degrees and millimetres between a pose and the true one."""
    rest = np.linalg.inv(np.asarray(pair(seed)[1][2].world_from_camera, float)) @ found
    angle = np.degrees(np.arccos(np.clip((np.trace(rest[:3, :3]) - 1) / 2, -1, 1)))
    return angle, 1000 * np.linalg.norm(rest[:3, 3])


@pytest.mark.parametrize("brightness", [1.0, 1.25])
def test_poses_of_rooms(benchmark, brightness):
    benchmark.group = f"pose of 640 x 480, brightness x {brightness}"
    methods = {
        "jaxfx": functools.partial(ours, with_depth=False),
        "jaxfx, both depths": functools.partial(ours, with_depth=True),
    }
    methods |= {name: globals()[name] for name in ("open3d",) if importlib.util.find_spec(name)}
    if importlib.util.find_spec("cv2"):
        methods["opencv"] = opencv
    timed = {name: functools.partial(call, 0, brightness) for name, call in methods.items()}
    milliseconds = in_turns(benchmark, timed, rounds=5)
    for name, call in methods.items():
        errors = np.array([off(call(seed, brightness), seed) for seed in range(8)])
        middle, worst = np.median(errors, axis=0), errors.max(axis=0)
        print(
            f"{name}: {milliseconds[name]:.0f} ms, off {middle[0]:.3f} degrees and "
            f"{middle[1]:.2f} mm in the median, {worst[0]:.3f} and {worst[1]:.1f} at worst"
        )
        benchmark.extra_info[f"{name}, off"] = [*middle, *worst]
        if name.startswith("jaxfx"):
            assert worst[0] < 0.1 and worst[1] < 10
