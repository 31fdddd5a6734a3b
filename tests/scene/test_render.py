"""The public functions that render: layers, empty views and bad arguments."""

import inspect

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh

from jaxfx import PinholeCamera, scene
from jaxfx.scene import _view


SIZE = {"height": 20, "width": 30}


@pytest.fixture
def view(ball):
    """A camera of 20 x 30 pixels that shows the ball."""
    return scene.default_camera(ball, **SIZE)


def test_layers_of_a_box_skip_its_inside(straight, backend):
    content = trimesh.Scene()
    for z in (0, -4):
        box = trimesh.creation.box((4, 4, 2))
        box.apply_translation([2, 2, z])
        content.add_geometry(box)
    boxes = scene.from_trimesh(content)
    options = {"height": 4, "width": 4, "backend": backend}
    for layer, depth in [(0, 2), (1, 6), (2, np.inf), (5, np.inf)]:
        buffer = scene.gbuffer(boxes, straight(4), **options, layer_index=layer)
        np.testing.assert_allclose(buffer.depth, depth)
        ids = scene.object_ids(boxes, straight(4), **options, layer_index=layer)
        np.testing.assert_array_equal(ids, -1 if layer > 1 else layer)


@pytest.mark.parametrize("tilt", [0.2, 1e-3, 1e-4])
def test_a_floor_seen_edge_on_does_not_show_behind_itself(backend, tilt):
    """Along a grazing ray a rounding error in position is a large error in depth."""
    turn = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)[:3, :3]
    corners = np.array([[-20, 0, -40], [20, 0, -40], [20, 0, 0], [-20, 0, 0]]) @ turn.T
    floor = scene.from_trimesh(trimesh.Trimesh(corners, [[2, 1, 0], [3, 2, 0]], process=False))
    size = {"height": 61, "width": 83}
    eye, target, up = turn @ [0.3, 20 * tilt, 3], turn @ [0.1, 0, -17], turn[:, 1]
    camera = PinholeCamera.look_at(eye, target, up=up, fov_y=tilt, **size)
    depth = [scene.depth(floor, camera, **size, backend=backend, layer_index=n) for n in (0, 1)]
    assert np.isfinite(depth[0]).all()
    assert np.isinf(depth[1]).all()


def test_a_trace_around_the_call_does_no_harm(backend, ball, view):
    nearest = lambda: scene.depth(ball, view, height=21, width=31, backend=backend).min()
    _view._homogeneous_centers.cache_clear()  # so that the trace is there for it all
    inside = jax.jit(lambda x: x + nearest())(np.float32(0))
    assert inside == nearest()


def test_nothing_in_view(backend, ball):
    away = PinholeCamera.look_at([0, 0, 6], [0, 0, 9], up=[0, 1, 0], fov_y=0.8, **SIZE)
    aside = PinholeCamera.look_at([0, 0, 6], [6, 0, 3], up=[0, 1, 0], fov_y=0.3, **SIZE)
    for camera in (away, aside):
        with pytest.raises(ValueError, match=r"scene\.gbuffer\(camera\).*nothing in view"):
            scene.gbuffer(ball, camera, **SIZE, backend=backend)
        assert np.isinf(scene.depth(ball, camera, **SIZE, backend=backend)).all()
        ids = scene.object_ids(ball, camera, **SIZE, backend=backend)
        np.testing.assert_array_equal(ids, -1)


@pytest.mark.parametrize("name", ["gbuffer", "depth", "object_ids", "material_ids"])
def test_bad_arguments(name, ball, view):
    # Unwrapped: jaxtyping's error would come before ours.
    call = inspect.unwrap(getattr(scene, name))
    for size in (
        {"height": 0, "width": 9},
        {"height": 9, "width": 2.5},
        {"height": True, "width": 9},
    ):
        with pytest.raises(ValueError, match=rf"scene\.{name}\((height|width)=\.\.\.\)"):
            call(ball, view, **size)
    with pytest.raises(ValueError, match=rf"scene\.{name}\(backend=\.\.\.\).*'vulkan'"):
        call(ball, view, **SIZE, backend="vulkan")
    with pytest.raises(ValueError, match=rf"scene\.{name}\(layer_index=\.\.\.\).*-1"):
        call(ball, view, **SIZE, layer_index=-1)


def test_bad_scenes_and_cameras(ball, view, monkeypatch):
    of = inspect.unwrap(_view.View.of.__func__)
    with pytest.raises(ValueError, match=r"scene\.depth\(camera\)` must be a PinholeCamera"):
        of(_view.View, "camera", "scene.depth")
    with pytest.raises(ValueError, match=r"scene\.depth\(scene\)` must be a Scene, got str"):
        inspect.unwrap(scene.depth)("x", view, **SIZE)
    changed = lambda focal: eqx.tree_at(
        lambda camera: camera.intrinsics, view, view.intrinsics.at[0, 0].set(focal)
    )
    broken = changed(np.nan)
    with pytest.raises(ValueError, match="must be finite"):
        scene.depth(ball, broken, **SIZE)
    flat = changed(0.0)
    with pytest.raises(ValueError, match="invertible"):
        scene.depth(ball, flat, **SIZE)
    with pytest.raises(ValueError, match="must be concrete, got a traced camera"):
        jax.jit(lambda c: scene.depth(ball, c, **SIZE))(view)


def test_a_place_that_is_rounded_is_said(backend, caplog):
    """Thousands of kilometres from the origin float32 has steps of a quarter of a unit."""
    place = np.array([4.1e6, 0, 2.9e6])
    aside = np.array([0.37, 0.21, 3.63])
    box = trimesh.creation.box((1, 1, 1)).apply_translation(place)
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = place + aside
    focal = np.array([[60.0, 0, 8], [0, 60, 8], [0, 0, 1]])
    draw = lambda camera: scene.depth(
        scene.from_trimesh(box), camera, height=16, width=16, backend=backend
    )
    assert float(draw(PinholeCamera(focal, pose)).min()) == pytest.approx(3.13, abs=1e-6)
    assert not caplog.records
    draw(PinholeCamera(focal.astype(np.float32), pose.astype(np.float32)))
    (record,) = caplog.records
    assert "the camera's position is rounded to 0.12 in float32" in record.getMessage()
