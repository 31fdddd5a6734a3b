"""Reference images for relighting, by Mitsuba, a path tracer, of the same meshes and lights.

Every surface is Lambert. Mitsuba traces one ray through each pixel's centre, so that its image
is not antialiased, like a G-buffer. Its radiance is 1 / pi of this package's under one light.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import mitsuba as mi
import numpy as np

from jaxfx import DirectionalLight, PointLight, SpotLight, scene, shadow
from jaxfx._sampling import pixel_centers
from jaxfx.io import linear_from_srgb


mi.set_variant("scalar_rgb")

# The border of a spot light has another profile in Mitsuba: this one is very narrow.
LIGHTS = {
    "directional": DirectionalLight([0.5, -0.9, -0.6], [1.0, 0.9, 0.8]),
    "point": PointLight([0.5, 1.4, -1.5], [2.0, 1.8, 1.5]),
    "spot": SpotLight([-0.5, 1.8, -0.8], [0.3, -0.9, -1.2], [4.0, 3.6, 3.0], 0.5, 0.500001),
}


def lambert(mesh, camera, size):
    """The mesh's G-buffer, with every surface Lambert."""
    gbuffer = scene.gbuffer(mesh, camera, height=size[0], width=size[1], backend="embree")
    shader = jnp.where(gbuffer.shader < 0, -1, 0)
    return eqx.tree_at(lambda gbuffer: gbuffer.shader, gbuffer, shader)


def shadow_of(mesh, gbuffer, camera, light, map_size=1024):
    """The light's visibility by unfiltered shadow maps."""
    ball = {"scene_center": mesh.center, "scene_radius": mesh.radius}
    cameras = shadow.light_cameras(light, map_size=map_size, **ball)
    take = functools.partial(scene.depth, mesh, height=map_size, width=map_size)
    maps = [take(light_camera, backend="embree") for light_camera in cameras]
    cameras = cameras if len(cameras) > 1 else cameras[0]
    receivers = shadow.receivers(gbuffer.depth, camera, cameras, normal=gbuffer.normal)
    return shadow.hard(jnp.concatenate(maps, axis=1), receivers, bias=2e-3, slope_bias=1.0)


def unshadowed(mesh, position, light):
    """1 where nothing lies between a point and the light, else 0."""
    if isinstance(light, DirectionalLight):
        direction = np.asarray(light.direction, float)
        end = np.asarray(position) - 4 * mesh.radius * direction / np.linalg.norm(direction)
    else:
        end = np.asarray(light.position, float)
    return np.asarray(scene.visible(mesh, position, end), np.float32)


def emitter(light):
    """The light as a dictionary for Mitsuba."""
    rgb = lambda color: {"type": "rgb", "value": np.asarray(color, float).tolist()}
    if isinstance(light, DirectionalLight):
        direction = np.asarray(light.direction, float)
        return {
            "type": "directional",
            "direction": (direction / np.linalg.norm(direction)).tolist(),
            "irradiance": rgb(light.color),
        }
    position = np.asarray(light.position, float)
    if isinstance(light, PointLight):
        return {
            "type": "point",
            "position": position.tolist(),
            "intensity": rgb(light.color),
        }
    target = position + np.asarray(light.direction, float)
    up = np.roll(np.asarray(light.direction, float), 1)
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(
            origin=position.tolist(), target=target.tolist(), up=up.tolist()
        ),
        "intensity": rgb(light.color),
        "beam_width": float(np.degrees(light.inner_angle)),
        "cutoff_angle": float(np.degrees(light.outer_angle)),
    }


def _shape(mesh, material, index):
    """The faces of one material as a Mitsuba mesh whose faces share no vertices."""
    faces = np.flatnonzero(mesh.face_materials == index)
    count = 3 * len(faces)
    uv = mesh.uv[faces].reshape(-1, 2)
    if material.texture is None:
        reflectance = {
            "type": "rgb",
            "value": (np.array(material.color) * bare(material)).tolist(),
        }
    else:
        texels = linear_from_srgb(material.texture / 255.0) * np.array(material.color)
        texels = (texels * bare(material)).astype(np.float32)
        reflectance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    )
    shape = mi.Mesh(
        "mesh",
        count,
        len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mesh.vertices[mesh.faces[faces]].astype(np.float32).ravel()
    parameters["vertex_normals"] = mesh.normals[faces].ravel()
    parameters["vertex_texcoords"] = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).ravel()
    parameters["faces"] = np.arange(count, dtype=np.uint32)
    parameters.update()
    return shape


def bare(material):
    """The fraction of the base colour that is diffuse."""
    return 1 - material.metallic


@functools.cache
def shapes(mesh):
    """All of a mesh's faces as Mitsuba meshes, one per material."""
    return {
        f"shape{index}": _shape(mesh, material, index)
        for index, material in enumerate(mesh.materials)
    }


def rays(camera, size):
    """A ray through each pixel's centre, row by row."""
    pixels = np.asarray(pixel_centers(*size), np.float64)
    pose = np.asarray(camera.world_from_camera, np.float64)
    inverse = np.linalg.inv(np.asarray(camera.intrinsics, np.float64))
    direction = (
        np.concatenate([pixels, np.ones((*size, 1))], axis=-1) @ inverse.T @ pose[:3, :3].T
    )
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    eye = pose[:3, 3].tolist()
    return [mi.RayDifferential3f(mi.Ray3f(eye, d.tolist())) for d in direction.reshape(-1, 3)]


def direct(mesh, camera, light, size, *, shadows):
    """The image under one light; without `shadows`, nothing blocks it."""
    world = mi.load_dict({"type": "scene", **shapes(mesh), "light": emitter(light)})
    image = np.zeros((size[0] * size[1], 3))
    context = mi.BSDFContext()
    for pixel, ray in enumerate(rays(camera, size)):
        hit = world.ray_intersect(ray)
        if hit.is_valid():
            sample, irradiance = world.sample_emitter_direction(hit, [0.5, 0.5], shadows)
            image[pixel] = irradiance * hit.bsdf(ray).eval(context, hit, hit.to_local(sample.d))
    return np.pi * image.reshape(*size, 3)


def bounced(mesh, camera, light, size, samples, *, seed=0, bounces=1):
    """Mitsuba's image of `bounces` bounces of indirect light, and its standard error."""
    world = mi.load_dict({"type": "scene", **shapes(mesh), "light": emitter(light)})
    path = lambda depth: mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
    once, more = path(2), path(2 + bounces)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    image, noise = (np.zeros((size[0] * size[1], 3)) for _ in range(2))
    for pixel, ray in enumerate(rays(camera, size)):
        direct_light = np.array(once.sample(world, sampler, ray)[0])
        paths = [more.sample(world, sampler, ray)[0] for _ in range(samples)]
        paths = np.array(paths, float).reshape(samples, 3)
        image[pixel] = paths.mean(axis=0) - direct_light
        noise[pixel] = paths.std(axis=0) / np.sqrt(samples)
    return np.pi * image.reshape(*size, 3), np.pi * noise.reshape(*size, 3)
