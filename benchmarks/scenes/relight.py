"""The still life under many lights, and the picture of it rendered anew."""

import functools

import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, PointLight, relight, scene
from jaxfx._sampling import pixel_centers
from jaxfx.scene.embree import accelerated


@functools.cache
def view(size):
    mesh = scene.still_life()
    return mesh, scene.default_camera(mesh, height=size[0], width=size[1])


@functools.cache
def cache(size):
    mesh, camera = view(size)
    return scene.gbuffer(mesh, camera, height=size[0], width=size[1]), camera


def lights(count, seed=0):
    """White point lights above the still life, which together are as bright as one."""
    rng = np.random.default_rng(seed)
    low, high = view((48, 64))[0].bounds
    middle = (low + high) / 2
    where = rng.uniform(-0.4, 0.4, (count, 3)) * (high - low) + middle
    where[:, 1] = high[1] - rng.uniform(0.1, 0.3, count) * (high[1] - low[1])
    color = np.full(3, 12 / count, np.float32)
    return [PointLight(position.astype(np.float32), color) for position in where]


@functools.cache
def new_view(size, count):
    """A camera, its depth, and the caches about it with their cameras."""
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
    """Where each pixel's shadow rays start, in the unit ball that Embree has the mesh in."""
    depth = gbuffer.depth
    height, width = depth.shape
    points = camera.unproject(pixel_centers(height, width, depth.dtype), depth)
    start = (np.asarray(points) - mesh.center) / mesh.radius + 1e-3 * np.asarray(gbuffer.normal)
    return np.where(np.isfinite(start), start, 0).reshape(-1, 3).astype(np.float32)


def unshadowed(mesh, start, light):
    """1 where nothing stands between a start and a point light, by one ray for each."""
    end = (np.asarray(light.position) - mesh.center) / mesh.radius
    reach = np.ones(len(start), np.float32)
    hit = accelerated(mesh).run(
        start, end.astype(np.float32) - start, dists=reach, query="OCCLUDED"
    )
    return hit < 0


def rendered_anew(mesh, camera, lights, size):
    """The picture with shadows, from the mesh: nothing is kept."""
    gbuffer = scene.gbuffer(mesh, camera, height=size[0], width=size[1], backend="embree")
    start = shadow_starts(mesh, gbuffer, camera)
    image = jnp.zeros((*size, 3), jnp.float32)
    for light in lights:
        visible = unshadowed(mesh, start, light).reshape(size)
        image = image + relight.shade(gbuffer, camera, light, visible.astype(np.float32))
    return image
