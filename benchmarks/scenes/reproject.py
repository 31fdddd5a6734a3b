"""Depth maps on which searches fail; peers and scores to measure reprojection against."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, relight, scene
from jaxfx._sampling import bilinear, pixel_centers
from jaxfx.reproject import intersect


# Depth maps, and rays across them that move `slope` texels per 0.1 of depth.


def camera(height=24, width=32, at=(0.0, 0.0, 0.0), turn=0.0):
    """A camera at a position, turned about the vertical axis by `turn`, in radians."""
    pose = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = at
    return PinholeCamera.from_fov(0.9, height=height, width=width, world_from_camera=pose)


def smooth(size):
    """Smooth waves."""
    y, x = np.mgrid[:size, :size] / size
    return 0.6 + 0.1 * np.sin(9 * x) * np.cos(7 * y)


def posts(size):
    """One-texel posts and one-texel gaps."""
    depth = np.full((size, size), 0.7)
    depth[4::9, 4::9] = 0.3
    depth[:, size // 2 :] = 0.4
    depth[4::9, size // 2 + 4 :: 9] = 0.7
    return depth


def cliff(size):
    """One step in depth."""
    depth = np.full((size, size), 0.8)
    depth[:, size // 2 :] = 0.3
    return depth


FIELDS = {"smooth": smooth, "posts": posts, "cliff": cliff}


def slanted_rays(size, slope):
    """A ray per texel, all in one direction."""
    y, x = np.mgrid[:size, :size] + 0.5
    origin = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    direction = np.array([np.cos(0.4), np.sin(0.4), 0.1 / max(slope, 1e-9)])
    if slope == 0:
        direction = np.array([0, 0, 1.0])
    back = 0.35 / direction[2] * direction
    return origin - back * (1, 1, 0), np.broadcast_to(direction, origin.shape)


# The rays that are timed: one per texel, through the whole range of depth.


def hills(side):
    """Smooth hills behind forty discs."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:side, :side] / side
    depth = 0.6 + 0.15 * np.sin(9 * x + 3 * y) * np.cos(7 * y - x)
    depth += 0.05 * np.sin(40 * x) * np.sin(37 * y)
    for _ in range(40):
        cx, cy, radius = rng.random(3) * [1, 1, 0.06]
        depth[(x - cx) ** 2 + (y - cy) ** 2 < radius**2] = rng.uniform(0.2, 0.5)
    return depth.astype(np.float32)


def fan(side, slant):
    """A fan of rays that slant to one side, by `slant` image sides, and begin in the image."""
    y, x = np.mgrid[:side, :side] + 0.5
    across = side * slant * np.array([np.cos(0.3), np.sin(0.3)])
    fan = 0.2 * (np.stack([x, y], axis=-1) - side / 2)
    direction = np.concatenate([across + fan, np.ones((side, side, 1))], axis=-1).reshape(-1, 3)
    start = np.stack([x, y], axis=-1).reshape(-1, 2) - direction[:, :2] / 2
    edge = np.where(direction[:, :2] > 0, 0, side)
    enter = np.maximum((edge - start) / direction[:, :2], 0).max(axis=1, keepdims=True)
    start = np.clip(start + enter * direction[:, :2], 0, side - 1e-3)
    origin = np.concatenate([start, enter], axis=1)
    return origin.astype(np.float32), direction.astype(np.float32)


run = jax.jit(intersect, static_argnames=("search", "max_steps", "surface"))


def error_rate(depth, slope, method, max_steps=None):
    """The fraction of rays with a wrong mask, or a hit more than a texel off."""
    origin, direction = slanted_rays(len(depth), slope)
    exact = run(depth, origin, direction)
    hit = run(depth, origin, direction, search=method, max_steps=max_steps)
    off = np.abs(np.asarray(hit.position - exact.position))[:, :2].max(axis=1) > 1
    wrong = np.asarray(hit.mask != exact.mask) | (off & np.asarray(exact.mask))
    return float(wrong.mean())


# A turned view, its reference, and two peers.


def orbit(eye, degrees, distance):
    """The camera turned by `degrees` about the point at `distance` on its axis."""
    pose, a = np.asarray(eye.world_from_camera, float), np.deg2rad(degrees)
    pivot = pose[:3, 3] + distance * pose[:3, 2]
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    new = np.eye(4)
    new[:3, :3] = turn @ pose[:3, :3]
    new[:3, 3] = pivot + turn @ (pose[:3, 3] - pivot)
    return PinholeCamera(eye.intrinsics, jnp.asarray(new, eye.intrinsics.dtype))


def photographer(mesh, side):
    """The mesh's default camera, and a function from a camera to image and depth."""
    eye = scene.default_camera(mesh, height=side, width=side)
    lights = scene.default_lights(eye)

    def taken(eye):
        buffer = scene.gbuffer(mesh, eye, height=side, width=side)
        return relight.render(buffer, eye, lights), buffer.depth

    return eye, taken


def from_target(depth, source, target):
    """The pixels and depths, in the source camera, of the points of the target's depth."""
    pixels = pixel_centers(*depth.shape, depth.dtype)
    points = target.unproject(pixels, jnp.where(depth < jnp.inf, depth, 1e6))
    return source.project(points)


def backward_warp(image, target_depth, source, target):
    """A cheap peer that knows the target's depth: it ignores occlusion in the source."""
    pixels, z = from_target(target_depth, source, target)
    height, width, _ = image.shape
    limits = jnp.asarray([width, height], pixels.dtype)[None, None]
    inside = ((pixels >= 0) & (pixels < limits)).all(axis=-1) & (z > 0)
    return jnp.where(inside[..., None], bilinear(image, pixels), 0), inside.astype(image.dtype)


def visible(depth, source, target, target_depth):
    """Which of the target's pixels are visible in the source, by the true depth of both."""
    pixels, z = map(np.asarray, from_target(jnp.asarray(target_depth), source, target))
    height, width = depth.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=-1) & (z > 0)
    column, row = np.clip(pixels, 0, (width - 1, height - 1)).astype(int).T
    return inside & (z < 1.03 * np.asarray(depth)[row.T, column.T])


def scores(drawn, alpha, truth, seen):
    """PSNR of the pixels that are drawn and visible; wrong pixels as fractions of the image."""
    shown = np.asarray(alpha) > 0
    error = np.mean((np.asarray(drawn) - np.asarray(truth))[seen & shown] ** 2)
    return {
        "PSNR": -10 * np.log10(error),
        "false hits": np.mean(shown & ~seen),
        "false holes": np.mean(seen & ~shown),
        "coverage": np.mean(shown),
    }


def depth_mesh(depth, source, threshold=0.1):
    """An exact peer: Embree with two triangles per four texels, none across a depth step."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    depth = jnp.where(jnp.isfinite(depth), depth, 1e3)
    pixels = pixel_centers(*depth.shape, depth.dtype)
    points = np.asarray(source.unproject(pixels, depth), np.float32)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
    corners = np.asarray(depth)
    four = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]])
    whole = four.max(axis=0) <= (1 + threshold) * four.min(axis=0)
    triangles = np.stack([a, c, b, b, c, d], axis=2)[whole].reshape(-1, 3, 3)
    mesh = EmbreeScene(robust=True)
    TriangleMesh(mesh, np.ascontiguousarray(triangles))
    return mesh


def trace(mesh, image, source, target, shape):
    """The target's image by ray tracing a `depth_mesh`, and where a ray hits."""
    pixels = pixel_centers(*shape, jnp.float32)
    start = np.asarray(target.unproject(pixels, jnp.zeros(shape, jnp.float32)))
    along = np.asarray(target.unproject(pixels, jnp.ones(shape, jnp.float32))) - start
    start, along = (np.ascontiguousarray(v.reshape(-1, 3), np.float32) for v in (start, along))
    distance = mesh.run(start, along, query="DISTANCE").reshape(shape)
    hit = distance < 1e8
    points = target.unproject(pixels, jnp.asarray(np.where(hit, distance, 1), jnp.float32))
    drawn = bilinear(jnp.asarray(image), source.project(points)[0])
    return jnp.where(hit[..., None], drawn, 0), hit.astype(np.float32)
