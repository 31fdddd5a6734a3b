"""Where light by way of other surfaces fails: bounces left out, mirrors and glass cut short."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from trimesh import Trimesh, creation, util

from jaxfx import PinholeCamera, SphericalHarmonicsLight, relight, scene
from tests.cases.registry import Found, case


SIZE = {"height": 24, "width": 32}

# Of a closed sphere: the reflectance, how many bounces are summed, sample points.
FURNACES = {
    "reflectance 0.2, 2 bounces": (0.2, 2, 300),
    "reflectance 0.5, 2 bounces": (0.5, 2, 300),
    "reflectance 0.5, 6 bounces": (0.5, 6, 300),
    "reflectance 0.5, 6 bounces, 20 points": (0.5, 6, 20),
    "reflectance 0.9, 2 bounces": (0.9, 2, 300),
}


@case("relight", {"lost": 0.1, "uneven": 0.05}, FURNACES, needs="embreex")
def bounces_left_out(method):
    """Inside a sphere under even light every bounce is the one before times the reflectance r,
    so that all of them are r / (1 - r) of the direct light. What the mean of `indirect` lacks
    of that, and how far pixels spread about their mean. n bounces lack r to the n: pale rooms
    need many. Few sample points lack more: each sends as a disc of its area, which is weaker
    than the point nearby."""
    reflectance, bounces, point_count = FURNACES[method]
    inside = creation.icosphere(2, radius=2.0)
    inside.invert()
    camera = PinholeCamera.from_fov(1.5, **SIZE)
    mesh = scene.from_trimesh(inside)
    gbuffer = scene.gbuffer(mesh, camera, **SIZE, backend="embree")
    transfer = scene.transfer(mesh, gbuffer, camera, point_count=point_count, rank=point_count)
    painted = lambda like: jnp.full_like(like, reflectance)
    gbuffer = dataclasses.replace(
        gbuffer, diffuse=painted(gbuffer.diffuse), shader=jnp.zeros_like(gbuffer.shader)
    )
    transfer = eqx.tree_at(lambda t: t.diffuse, transfer, painted(transfer.diffuse))
    even = SphericalHarmonicsLight(np.pad([[1.0, 1, 1]], ((0, 8), (0, 0))))
    direct = np.asarray(relight.shade(gbuffer, camera, even), float)
    image = np.asarray(relight.indirect(gbuffer, transfer, [even], bounces=bounces), float)
    share = image / (direct * reflectance / (1 - reflectance))
    figures = {"lost": abs(1 - share.mean()), "uneven": share.std() / share.mean()}
    return Found({name: float(figure) for name, figure in figures.items()}, share / 2)


def plane(axis, at, half=20.0):
    """Two triangles across an axis; their front faces up, or along +z or -z to the origin."""
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    places = np.insert(corners, axis, at, axis=1)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normal = np.cross(*(places[faces[0, 1:]] - places[faces[0, 0]]))[axis]
    is_inward = normal > 0 if axis == 1 else normal * at < 0
    return Trimesh(places, faces if is_inward else faces[:, ::-1], process=False)


def landed(second, rays):
    """Where rays end, per pixel; NaN where they meet nothing."""
    origins, directions = (np.asarray(field, float) for field in rays)
    depth = np.where(np.isfinite(second.depth), second.depth, np.nan)
    return origins + depth[..., None] * directions


def through_a_pane(faces):
    """Where rays through glass of 0.3 land on a floor, and where Snell's law says."""
    eye, index, thickness = np.array([0.3, 1.2, 3.0]), 1.5, 0.3
    camera = PinholeCamera.look_at(eye, [0, 0, 0], up=[0, 1, 0], fov_y=0.9, **SIZE)
    pane, floor = creation.box((4.0, thickness, 4.0)), plane(1, -1.0)
    both = scene.from_trimesh(util.concatenate([pane, floor]))
    first = scene.gbuffer(both, camera, **SIZE, backend="embree")
    rays = relight.refracted(first, camera, index=index)
    is_pane = np.abs(rays.origins[..., 1] - thickness / 2) < 1e-4
    second = scene.gbuffer_along(both, rays)
    is_pane &= np.abs(landed(second, rays)[..., 1] + thickness / 2) < 1e-4
    if faces == 2:
        rays = relight.refracted(second, rays, index=1 / index)
    end = landed(scene.gbuffer_along(scene.from_trimesh(floor), rays), rays)
    toward = np.asarray(camera.rays(**SIZE).directions, float)
    across = toward * [1, 0, 1]
    sine = np.linalg.norm(across, axis=-1) / np.linalg.norm(toward, axis=-1)
    tangent = lambda sine: sine / np.sqrt(1 - sine**2)
    aside = (eye[1] + 1 - thickness) * tangent(sine) + thickness * tangent(sine / index)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    expected = eye * [1, 0, 1] - [0, 1, 0] + aside[..., None] * across
    return end, expected, is_pane


def in_a_corner(mirrors):
    """Where rays land behind the camera by way of a floor and a wall of mirror."""
    eye = np.array([0.3, 1.2, 3.0])
    camera = PinholeCamera.look_at(eye, [0, 0, -2], up=[0, 1, 0], fov_y=0.9, **SIZE)
    mesh = scene.from_trimesh(util.concatenate([plane(1, 0.0), plane(2, -2.0), plane(2, 6.0)]))
    first = scene.gbuffer(mesh, camera, **SIZE, backend="embree")
    rays = relight.mirrored(first, camera)
    second = scene.gbuffer_along(mesh, rays)
    # Two rays in three meet the floor and then the wall, or the wall and then the floor.
    on_mirrors = [
        np.abs(v) < 1e-4 for v in np.moveaxis(landed(second, rays) - [0, 0, -2], 2, 0)
    ]
    is_second = on_mirrors[1] | on_mirrors[2]
    if mirrors == 2:
        rays = relight.mirrored(second, rays)
        second = scene.gbuffer_along(mesh, rays)
    end = landed(second, rays)
    # The camera mirrored in both planes sees the same without them.
    toward = np.asarray(camera.rays(**SIZE).directions, float) * [1, -1, -1]
    source = eye * [1, -1, -1] - [0, 0, 4]
    expected = source + (6 - source[2]) / toward[..., 2:] * toward
    return end, expected, is_second & (np.abs(expected[..., :2] - [0, 0]) < 19).all(axis=-1)


PATHS = {
    "glass, both faces": (through_a_pane, 2),
    "glass, first face alone": (through_a_pane, 1),
    "two mirrors, followed twice": (in_a_corner, 2),
    "two mirrors, followed once": (in_a_corner, 1),
}


@case("relight", {"off": 1e-4}, PATHS, "none: `scene` traces on the host", needs="embreex")
def paths_cut_short(method):
    """Where rays through a pane, or by way of two mirrors, end, against Snell's law and cameras
    in mirrors: the mean distance over the length from the camera. A cache along rays goes to
    the next surface and no farther: glass has two faces, and what is mirrored may be a mirror.
    Another cache, along the rays of the first, goes on."""
    find, steps = PATHS[method]
    end, expected, is_asked = find(steps)
    is_asked = is_asked & np.isfinite(end).all(axis=-1)
    assert is_asked.sum() > 100
    away = np.linalg.norm(end - expected, axis=-1)[is_asked].mean()
    length = np.linalg.norm(expected - [0.3, 1.2, 3.0], axis=-1)[is_asked].mean()
    # Squares of 2, whose borders are on none of the planes.
    checks = np.floor(np.nan_to_num(end) / 2 + 0.25).sum(axis=-1) % 2
    return Found({"off": float(away / length)}, np.where(is_asked, 0.2 + 0.6 * checks, 0.0))
