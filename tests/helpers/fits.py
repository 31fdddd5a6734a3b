"""Small fits as functions of arrays, and batches of those arrays: frames, or starts."""

import functools

import jax.numpy as jnp
import numpy as np

from jaxfx import (
    DirectionalLight,
    GBuffer,
    PinholeCamera,
    PointLight,
    ThinLens,
    dof,
    fit,
    relight,
    reproject,
)


SIDE = 12
LENS = ThinLens(0.2, 3.0, 40.0)
DEPTH = np.broadcast_to(np.linspace(2, 4, SIDE), (SIDE, SIDE))
CAMERA = PinholeCamera.from_fov(1.0, height=SIDE, width=SIDE)


def lens_of_frames(count):
    """The aperture of each photograph, of its own image."""
    images = np.random.default_rng(0).random((count, SIDE, SIDE, 1))
    true = np.linspace(0.18, 0.24, count)
    options = {"parameters": ["aperture"], "max_coc": 4, "max_steps": 4, "loss": "squares"}

    def fitted(aperture, image):
        photograph = dof.scatter(image, DEPTH, ThinLens(aperture, 3.0, 40.0), max_coc=4)
        return fit.dof(photograph, image, DEPTH, LENS, throw=False, **options)

    return fitted, (true, images)


def lens_of_starts(count):
    """The lens of one photograph, robustly, from several starts."""
    image = np.random.default_rng(0).random((SIDE, SIDE, 1))
    photograph = dof.scatter(image, DEPTH, LENS, max_coc=4)

    def fitted(aperture):
        start = ThinLens(aperture, 2.8, 40.0)
        return fit.dof(photograph, image, DEPTH, start, max_coc=4, max_steps=3, throw=False)

    return fitted, (np.linspace(0.2, 0.3, count),)


def cameras(count):
    """The pose of each photograph."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    image = np.stack([np.sin(9 * x), np.cos(7 * y), np.sin(5 * x * y)], axis=-1)
    depth = 2 + 0.3 * np.sin(3 * x)
    poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    poses[:, 0, 3] = np.linspace(-0.05, 0.05, count)

    def fitted(pose):
        seen = PinholeCamera(CAMERA.intrinsics, pose)
        photograph, _ = reproject.warp(image, depth, CAMERA, seen, height=SIDE, width=SIDE)
        return fit.camera(photograph, image, depth, CAMERA, CAMERA, max_steps=4, throw=False)

    return fitted, (poses,)


def lights(count):
    """A sun and a lamp of each photograph."""
    shape = SIDE, SIDE
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(*shape, 3)) * 0.4 - np.array([0, 0, 1])
    white = np.ones((*shape, 3))
    gbuffer = GBuffer(
        depth=2 + rng.random(shape),
        roughness=np.ones(shape),
        color=white,
        diffuse=rng.uniform(0.3, 1, (*shape, 3)),
        specular=0 * white,
        ambient=white,
        normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        shader=np.zeros(shape, int),
    )
    start = [
        DirectionalLight([0.2, 0, 1], [1, 1, 1]),
        PointLight([0.5, -0.5, 0.5], [1, 1, 1]),
    ]

    def fitted(color, place):
        seen = [DirectionalLight(jnp.array([0.1, 0.1, 1]), color), PointLight(place, color)]
        photograph = functools.reduce(
            jnp.add, [relight.shade(gbuffer, CAMERA, light) for light in seen]
        )
        return fit.lights(photograph, gbuffer, CAMERA, start, max_steps=12, throw=False)

    return fitted, (
        rng.uniform(1, 3, (count, 3)),
        np.array([0.4, -0.4, 0.6]) + rng.uniform(-0.05, 0.05, (count, 3)),
    )


FITS = {
    "dof": lens_of_frames,
    "dof, starts": lens_of_starts,
    "camera": cameras,
    "lights": lights,
}
