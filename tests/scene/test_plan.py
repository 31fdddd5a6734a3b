"""Plans of views against every choice of as many, and against depth maps."""

import itertools

import numpy as np
import pytest
import trimesh

from jaxfx import OrthographicCamera, PinholeCamera, scene


SIZE = {"height": 18, "width": 24}
ROOM = scene.still_life()


def path(count=7):
    """Cameras on an arc about the still life's middle."""
    at = np.array(ROOM.viewpoint.at)
    offset = np.array(ROOM.viewpoint.eye) - at
    cameras = []
    for angle in np.linspace(-0.6, 0.6, count):
        turn = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        eye = at + turn @ offset
        cameras.append(PinholeCamera.look_at(eye, at, up=[0, 1, 0], fov_y=0.8, **SIZE))
    return cameras


def share_seen(chosen, targets):
    """The share of the targets' pixels whose points lie in depth maps; no ray is traced."""
    fine = 8
    maps = []
    for camera in chosen:
        large = PinholeCamera(camera.intrinsics.at[:2].mul(fine), camera.world_from_camera)
        size = {side: fine * pixels for side, pixels in SIZE.items()}
        maps.append((large, np.asarray(scene.depth(ROOM, large, **size, backend="embree"))))
    seen, total = 0, 0
    for target in targets:
        depth = np.asarray(scene.depth(ROOM, target, **SIZE, backend="embree"), float)
        met = np.isfinite(depth)
        points = target.points(np.where(met, depth, 1))
        covered = np.zeros(met.shape, bool)
        for large, cached in maps:
            pixels, z = map(np.asarray, large.project(points))
            x, y = np.floor(pixels).astype(int).transpose(2, 0, 1)
            inside = (
                (z > 0) & (x >= 0) & (y >= 0) & (x < cached.shape[1]) & (y < cached.shape[0])
            )
            held = cached[np.where(inside, y, 0), np.where(inside, x, 0)]
            covered |= inside & (np.abs(held - z) < 0.04 * z)
        seen, total = seen + (covered & met).sum(), total + met.sum()
    return seen / total


def test_the_share_is_that_of_depth_maps():
    targets = path()
    plan = scene.plan_views(ROOM, targets, count=3, **SIZE)
    assert list(plan.covered) == sorted(plan.covered)
    for some in (1, 3):
        expected = share_seen(plan.cameras[:some], targets)
        assert plan.covered[some - 1] == pytest.approx(expected, abs=0.03)


def test_greedy_is_near_the_best_choice_and_no_worse_than_even_steps():
    targets = path()
    plan = scene.plan_views(ROOM, targets, count=2, **SIZE)
    of = lambda chosen: scene.plan_views(
        ROOM, targets, candidates=chosen, count=2, **SIZE
    ).covered[-1]
    best = max(of(list(pair)) for pair in itertools.combinations(targets, 2))
    assert best * 0.97 <= plan.covered[-1] <= best
    assert plan.covered[-1] >= of([targets[1], targets[5]])


def test_the_back_of_a_sheet_is_not_its_front():
    """From behind, nothing of what is seen in front; two cameras see both."""
    quad = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], float)
    sheet = scene.from_trimesh(trimesh.Trimesh(quad, [[0, 1, 2], [0, 2, 3]], process=False))
    look = {"at": [0, 0, 0], "up": [0, 1, 0], "fov_y": 0.7} | SIZE
    front = PinholeCamera.look_at([0, 0, 3], **look)
    back = PinholeCamera.look_at([0, 0, -3], **look)
    plan = scene.plan_views(sheet, [front], candidates=[back, front], count=2, **SIZE)
    assert plan.indices == (1,)
    assert plan.covered == (1.0,)
    plan = scene.plan_views(sheet, [front, back], count=5, **SIZE)
    assert plan.covered == (0.5, 1.0)


def test_an_orthographic_camera_sees_along_its_axis():
    quad = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], float)
    sheet = scene.from_trimesh(trimesh.Trimesh(quad, [[0, 1, 2], [0, 2, 3]], process=False))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 3
    wide = OrthographicCamera(6.0, [12, 9], pose)
    narrow = OrthographicCamera(12.0, [12, 9], pose)
    plan = scene.plan_views(sheet, [wide], candidates=[narrow], count=1, **SIZE)
    assert plan.covered[0] == pytest.approx(0.25, abs=1e-9)


def test_errors_name_the_argument():
    targets = path(2)
    with pytest.raises(ValueError, match=r"`scene.plan_views\(targets\)` must be a sequence"):
        scene.plan_views(ROOM, [], count=1, **SIZE)
    with pytest.raises(ValueError, match=r"`scene.plan_views\(count=...\)` must be a positive"):
        scene.plan_views(ROOM, targets, count=0, **SIZE)
    away = PinholeCamera.look_at([0, 50, 0], [0, 99, 0], up=[1, 0, 0], fov_y=0.5, **SIZE)
    with pytest.raises(ValueError, match=r"`scene.plan_views\(targets\)` must see the scene"):
        scene.plan_views(ROOM, [away], count=1, **SIZE)
