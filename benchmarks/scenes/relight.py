"""The still life under many lights and lights of every kind, its image rendered from the mesh
for every edit, and surroundings.
"""

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxfx import (
    DirectionalLight,
    EnvironmentLight,
    PinholeCamera,
    PointLight,
    SphericalHarmonicsLight,
    SpotLight,
    relight,
    scene,
)
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


SHADERS = {"Lambert": 0, "Phong": 1, "Blinn": 2, "GGX": 3, "GGX, shader 4": 4}


@functools.cache
def cache_of(size, shader):
    """As `cache`, every surface of one shader: a key of `SHADERS`."""
    gbuffer, camera = cache(size)
    one = jnp.where(gbuffer.shader < 0, -1, SHADERS[shader])
    return eqx.tree_at(lambda g: g.shader, gbuffer, one), camera


KINDS = ("directional", "point", "spot", "harmonics", "environment")


def light_of(kind, turn):
    """A light of a kind, float32, which turns with an angle in degrees."""
    side = np.float32(np.sin(np.radians(turn)))
    place = np.array([side, 1.1, -1.8], np.float32)
    match kind:
        case "directional":
            return DirectionalLight(np.array([side, -1, 0.5], np.float32), np.ones(3))
        case "point":
            return PointLight(place, np.ones(3))
        case "spot":
            axis = np.array([0, -1, 0.5], np.float32)
            return SpotLight(place, axis, np.ones(3), 0.4, 0.9)
        case "harmonics":
            coefficients = np.zeros((9, 3), np.float32)
            coefficients[0], coefficients[3] = 1, side
            return SphericalHarmonicsLight(coefficients)
    return _surroundings_light().turned(about_y(turn).astype(np.float32))


@functools.cache
def _surroundings_light():
    return EnvironmentLight(surroundings())


def surroundings(height: int = 128) -> np.ndarray:
    """A picture of all directions: a blue sky with a low sun behind haze, brown ground."""
    rows, columns = np.mgrid[:height, : 2 * height] + 0.5
    above, right = np.pi * (0.5 - rows / height), np.pi * (columns / height - 1)
    way = [np.cos(above) * np.sin(right), np.sin(above), -np.cos(above) * np.cos(right)]
    way = np.stack(way, axis=-1)
    is_up = 1 / (1 + np.exp(-12 * way[..., 1:2]))
    sky = np.array([0.25, 0.45, 0.9]) + np.array([0.5, 0.4, 0.2]) * (1 - np.abs(way[..., 1:2]))
    picture = is_up * sky + (1 - is_up) * np.array([0.22, 0.15, 0.1])
    sun = np.array([-0.7, 0.5, 0.3]) / np.linalg.norm([-0.7, 0.5, 0.3])
    near = (way @ sun)[..., None] - 1
    glow = np.array([4, 3, 2]) * np.exp(12 * near) + np.array([40, 34, 26]) * np.exp(200 * near)
    return (picture + glow).astype(np.float32)


def about_y(degrees: float) -> np.ndarray:
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def still_life() -> scene.Scene:
    """The still life, every material shaded by GGX."""
    room = scene.still_life()
    materials = [dataclasses.replace(m, shader="ggx") for m in room.materials]
    return dataclasses.replace(room, materials=tuple(materials))


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
