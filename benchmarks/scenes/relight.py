"""The still life under many lights, and its image rendered from the mesh for every edit."""

import functools

import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, PointLight, relight, scene
from jaxfx._sampling import pixel_centers
from jaxfx.scene.embree import accelerated


@functools.cache
def view(size):
    """The mesh and its default camera."""
    mesh = scene.still_life()
    return mesh, scene.default_camera(mesh, height=size[0], width=size[1])


@functools.cache
def cache(size):
    """The mesh's G-buffer and its camera."""
    mesh, camera = view(size)
    return scene.gbuffer(mesh, camera, height=size[0], width=size[1]), camera


def lights(count, seed=0):
    """`count` white point lights above the still life, of one total intensity for any count."""
    rng = np.random.default_rng(seed)
    low, high = view((48, 64))[0].bounds
    middle = (low + high) / 2
    positions = rng.uniform(-0.4, 0.4, (count, 3)) * (high - low) + middle
    positions[:, 1] = high[1] - rng.uniform(0.1, 0.3, count) * (high[1] - low[1])
    color = np.full(3, 12 / count, np.float32)
    return [PointLight(position.astype(np.float32), color) for position in positions]


@functools.cache
def new_view(size, count):
    """A new camera, its depth, and `count` caches around it with their cameras."""
    mesh, _ = view(size)
    look = mesh.viewpoint
    offsets = np.array(
        [
            *([-1, 0, 0], [1, 0, 0], [0, 0.4, 0], [0, -0.3, 0]),
            *([-0.5, 0.3, 0], [0.5, 0.3, 0], [-0.5, -0.3, 0.3], [0.5, -0.3, 0.3]),
        ]
    )
    place = lambda offset: PinholeCamera.look_at(
        np.array(look.eye) + offset,
        look.at,
        up=[0, 1, 0],
        fov_y=look.fov,
        height=size[0],
        width=size[1],
    )
    render = lambda camera: scene.gbuffer(mesh, camera, height=size[0], width=size[1])
    cameras = [place(offset) for offset in offsets[:count]]
    target = place(np.array([0.2, 0.1, 0.0]))
    return target, render(target).depth, [render(camera) for camera in cameras], cameras


def shadow_starts(mesh, gbuffer, camera):
    """The origins of the pixels' shadow rays, in the coordinates of `Scene.unit_triangles`."""
    depth = gbuffer.depth
    height, width = depth.shape
    points = camera.unproject(pixel_centers(height, width, depth.dtype), depth)
    start = (np.asarray(points) - mesh.center) / mesh.radius + 1e-3 * np.asarray(gbuffer.normal)
    return np.where(np.isfinite(start), start, 0).reshape(-1, 3).astype(np.float32)


def unshadowed(mesh, start, light):
    """Whether nothing lies between each origin and a point light, by one ray each."""
    end = (np.asarray(light.position) - mesh.center) / mesh.radius
    reach = np.ones(len(start), np.float32)
    hit = accelerated(mesh).run(
        start, end.astype(np.float32) - start, dists=reach, query="OCCLUDED"
    )
    return hit < 0


def rendered_anew(mesh, camera, lights, size):
    """The image with traced shadows, rendered from the mesh: nothing is reused."""
    gbuffer = scene.gbuffer(mesh, camera, height=size[0], width=size[1], backend="embree")
    start = shadow_starts(mesh, gbuffer, camera)
    image = jnp.zeros((*size, 3), jnp.float32)
    for light in lights:
        visible = unshadowed(mesh, start, light).reshape(size)
        image = image + relight.shade(gbuffer, camera, light, visible.astype(np.float32))
    return image
