"""Caches along rays: of a camera, of a plane mirror, through a pane of glass."""

import inspect

import numpy as np
import pytest
from trimesh import Trimesh, creation, util

from jaxfx import PinholeCamera, relight, scene
from jaxfx.camera import Rays


pytestmark = pytest.mark.skipif(
    scene.embree.problem() is not None, reason="Embree does not work on this machine."
)
HEIGHT, WIDTH = 24, 32
SIZE = {"height": HEIGHT, "width": WIDTH}
EYE = np.array([0.3, 1.2, 3.0])
CAMERA = PinholeCamera.look_at(EYE, [0, 0, 0], up=[0, 1, 0], fov_y=0.9, **SIZE)


def things():
    ball, box = creation.icosphere(2, radius=0.5), creation.box((0.5, 0.8, 0.6))
    ball.apply_translation([-0.5, 0.8, -0.3])
    box.apply_translation([0.6, 0.7, 0.2])
    return [ball, box]


def floor(y=0.0, half=3.0):
    corners = np.array([[-half, y, -half], [half, y, -half], [half, y, half], [-half, y, half]])
    return Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def points(gbuffer, rays):
    origins, directions = (np.asarray(field, float) for field in rays)
    depth = np.where(np.isfinite(gbuffer.depth), gbuffer.depth, 0.0)
    return origins + depth[..., None] * directions


def same(found, expected):
    """Of two caches, where they show the same: most pixels, and in each all images."""
    alike = np.array(found.shader == expected.shader)
    for name in ("normal", "diffuse", "specular"):
        near = np.abs(getattr(found, name) - getattr(expected, name)).max(axis=-1) < 1e-4
        alike &= np.asarray(near)
    return alike


def test_rays_of_a_camera_show_what_the_camera_sees():
    mesh, rays = scene.from_trimesh(util.concatenate(things())), CAMERA.rays(**SIZE)
    found = scene.gbuffer_along(mesh, rays)
    expected = scene.gbuffer(mesh, CAMERA, **SIZE, backend="embree")
    alike = same(found, expected)
    assert alike.mean() > 0.99
    shown = alike & np.isfinite(found.depth)
    assert 70 < shown.sum() < 700
    gap = points(found, rays) - np.asarray(CAMERA.points(expected.depth))
    np.testing.assert_allclose(gap[shown], 0, atol=1e-5)
    doubled = rays._replace(directions=2 * rays.directions)
    half = scene.gbuffer_along(mesh, doubled).depth
    np.testing.assert_allclose(2 * np.asarray(half)[shown], found.depth[shown], rtol=1e-6)


def test_a_plane_mirror_shows_the_mirrored_cameras_cache():
    """The camera below the floor, whose picture is turned about a vertical line."""
    mesh = scene.from_trimesh(util.concatenate([*things(), floor()]))
    first = scene.gbuffer(mesh, CAMERA, **SIZE, backend="embree")
    rays = relight.mirrored(first, CAMERA)
    found = scene.gbuffer_along(mesh, rays)
    mirror = np.diag([1.0, -1, 1, 1])
    pose = mirror @ np.asarray(CAMERA.world_from_camera) @ np.diag([-1.0, 1, 1, 1])
    other = PinholeCamera(CAMERA.intrinsics, pose)
    alone = scene.from_trimesh(util.concatenate(things()))
    expected = scene.gbuffer(alone, other, **SIZE, backend="embree")
    turned = type(expected)(*(np.asarray(v)[:, ::-1] for v in vars(expected).values()))
    on_floor = np.abs(np.asarray(rays.origins)[..., 1]) < 1e-5
    on_floor &= np.asarray(first.shader) >= 0
    alike = same(found, turned)[on_floor]
    assert on_floor.sum() > 300 and alike.mean() > 0.98
    shown = on_floor & same(found, turned) & np.isfinite(np.asarray(turned.depth))
    assert shown.sum() > 40
    gap = points(found, rays) - np.asarray(other.points(expected.depth))[:, ::-1]
    np.testing.assert_allclose(gap[shown], 0, atol=1e-4)


def test_a_pane_shifts_what_is_behind_it():
    """In by an index, out by its inverse: as before, aside by d sin(a - b) / cos b."""
    pane = creation.box((4.0, 0.3, 4.0))
    mesh = scene.from_trimesh(pane)
    first = scene.gbuffer(mesh, CAMERA, **SIZE, backend="embree")
    inside = relight.refracted(first, CAMERA, index=1.5)
    second = scene.gbuffer_along(mesh, inside)
    after = relight.refracted(second, inside, index=1 / 1.5)
    top = np.abs(np.asarray(first.normal)[..., 1] - 1) < 1e-6
    straight = top & (np.abs(np.asarray(second.normal)[..., 1] - 1) < 1e-6)
    assert straight.sum() > 300
    toward = np.asarray(CAMERA.rays(**SIZE).directions)[straight]
    np.testing.assert_allclose(np.asarray(after.directions)[straight], toward, atol=1e-5)
    moved = np.asarray(after.origins - inside.origins)[straight]
    aside = np.linalg.norm(np.cross(moved, toward), axis=-1)
    a = np.arccos(-toward[:, 1])
    b = np.arcsin(np.sin(a) / 1.5)
    np.testing.assert_allclose(aside, 0.3 * np.sin(a - b) / np.cos(b), atol=1e-5)
    # In glass the side wall is met from within, beyond the critical angle.
    reflected = np.asarray(first.shader >= 0) & ~straight
    assert not np.asarray(after.directions)[reflected & (np.asarray(second.shader) < 0)].any()


def test_no_ray_no_surface():
    mesh = scene.from_trimesh(things()[1])
    rays = CAMERA.rays(**SIZE)
    toward = np.array(rays.directions)
    toward[0] = 0
    toward[1] = np.nan
    found = scene.gbuffer_along(mesh, rays._replace(directions=toward))
    full = scene.gbuffer_along(mesh, rays)
    assert np.isinf(found.depth[:2]).all() and (found.shader[:2] == -1).all()
    np.testing.assert_array_equal(found.depth[2:], full.depth[2:])


def test_errors_name_the_argument():
    along, rays = inspect.unwrap(scene.gbuffer_along), CAMERA.rays(**SIZE)
    mesh = scene.from_trimesh(things()[1])
    for arguments, message in (
        ((None, rays), r"`scene.gbuffer_along\(scene\)` must be a Scene"),
        ((mesh, CAMERA), r"`scene.gbuffer_along\(rays\)` must be Rays, got PinholeCamera"),
        ((mesh, Rays(rays.origins[0], rays.directions)), r"`scene.gbuffer_along\(rays.orig"),
        ((mesh, Rays(rays.origins[:2], rays.directions)), r"`scene.gbuffer_along\(rays\)` mus"),
    ):
        with pytest.raises(ValueError, match=message):
            along(*arguments)
