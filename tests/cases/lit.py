"""Lights on a ball before a wave, and shadows of spheres that no model of them has."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PointLight,
    SpotLight,
    relight,
)


SIZE = 32
CAMERA = OrthographicCamera(SIZE / 4, jnp.array([SIZE / 2, SIZE / 2]), jnp.eye(4))
ANGLES = "inner_angle", "outer_angle"


@functools.cache
def cache(dtype=np.float64):
    """A shiny ball before a matt wave, of random colours, seen from z = 0."""
    rng = np.random.default_rng(0)
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 4 - 2
    depth = 4 + 0.3 * np.sin(2 * x) * np.cos(1.5 * y)
    slopes = 0.6 * np.cos(2 * x) * np.cos(1.5 * y), -0.45 * np.sin(2 * x) * np.sin(1.5 * y)
    normal = np.stack([*slopes, -np.ones_like(x)], axis=-1)
    ball = x * x + y * y < 1
    front = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    depth = np.where(ball, 4 - front, depth)
    normal = np.where(ball[..., None], np.stack([x, y, -front], axis=-1), normal)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    base = rng.uniform(0.3, 0.8, (SIZE, SIZE, 3))
    images = base, base, base, np.full_like(base, 0.3), normal, depth, np.full_like(x, 0.3)
    color, ambient, diffuse, specular, normal, depth, roughness = (
        image.astype(dtype) for image in images
    )
    shader = np.where(ball, 2, 0)
    return GBuffer(color, shader, ambient, diffuse, specular, normal, depth, roughness)


@functools.cache
def points():
    """What each pixel shows, in world space: 8 pixels a unit, seen along z."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 4 - 2
    return np.stack([x, y, np.asarray(cache().depth)], axis=-1)


def towards(light, point):
    """The way from points to a light: to where it is, or so far that it does not matter."""
    if isinstance(light, DirectionalLight):
        direction = np.asarray(light.direction) / np.linalg.norm(light.direction)
        return np.broadcast_to(-3 * direction, point.shape)
    return np.asarray(light.position) - point


def shadow_of(light, centre, radius):
    """Where a sphere stands between a point and a light."""
    way = towards(light, points())
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    to = centre - points()
    along = np.sum(to * way / length, axis=-1, keepdims=True)
    beside = np.linalg.norm(to - along * way / length, axis=-1)
    is_between = (along > 0) & (isinstance(light, DirectionalLight) | (along < length))
    return (beside < radius) & is_between[..., 0]


def sphere_shadows(light, rng, count):
    """What of a light gets past spheres that stand on its way to what is seen."""
    visible = np.ones((SIZE, SIZE))
    for _ in range(0 if isinstance(light, AmbientLight) else count):
        point = points()[tuple(rng.integers(2, SIZE - 2, 2))]
        centre = point + rng.uniform(0.2, 0.6) * towards(light, point)
        visible *= ~shadow_of(light, centre, rng.uniform(0.15, 0.35))
    return visible


def drawn(kind, rng):
    """A light of a kind, over the scene."""
    color = rng.uniform(0.5, 1.5, 3)
    if kind is AmbientLight:
        return AmbientLight(0.3 * color)
    if kind is DirectionalLight:
        return DirectionalLight([*rng.uniform(-0.6, 0.6, 2), 1.0], color)
    place = np.array([*rng.uniform(-1.5, 1.5, 2), rng.uniform(1.0, 2.2)])
    if kind is PointLight:
        return PointLight(place, 2 * color)
    place[2] -= 0.5
    aim = np.array([*rng.uniform(-0.7, 0.7, 2), 4.0])
    angles = rng.uniform(0.15, 0.25), rng.uniform(0.4, 0.6)
    return SpotLight(place, aim - place, 6 * color, *angles)


def beside(light, rng):
    """A start for a light: some 10 degrees and a quarter of a unit off, white."""
    fields: dict[str, Any] = vars(light) | {"color": jnp.ones(3)}
    if "position" in fields:
        fields["position"] = light.position + 0.15 * rng.normal(size=3)
    if "direction" in fields:
        length = np.linalg.norm(light.direction)
        fields["direction"] = light.direction / length + 0.1 * rng.normal(size=3)
    if "inner_angle" in fields:
        fields["inner_angle"] = light.inner_angle * rng.uniform(0.8, 1.2)
        fields["outer_angle"] = light.outer_angle * rng.uniform(0.85, 1.15)
    return type(light)(**fields)


def problem(seed, kinds=(DirectionalLight, PointLight), noise=0.01, spheres=3):
    """An image with noise, a share of its root mean square; its lights; a start."""
    rng = np.random.default_rng(seed)
    lights = [drawn(kind, rng) for kind in kinds]
    seen = [sphere_shadows(light, rng, spheres) for light in lights]
    image = np.asarray(relight.render(cache(), CAMERA, lights, visibilities=seen))
    image = image + noise * np.sqrt(np.mean(image**2)) * rng.normal(size=image.shape)
    return image, lights, [beside(light, rng) for light in lights]


def misses(fitted, truth):
    """By light and parameter: how far off, and the error that is stated; arrays of both.

    Of a direction the angle in radians, over the root of 2: it has two parts.
    """
    found = {}
    pairs = zip(fitted.lights, truth, fitted.standard_errors, strict=True)
    for index, (light, true, errors) in enumerate(pairs):
        for name, error in errors.items():
            parts = np.sqrt(2) if name == "direction" else 1
            if name == "direction":
                ways = [np.asarray(each.direction) for each in (light, true)]
                one, other = (way / np.linalg.norm(way) for way in ways)
                miss = 2 * np.arcsin(np.linalg.norm(one - other) / 2) / parts
            elif name == "angles":
                inner, outer = (getattr(light, n) - getattr(true, n) for n in ANGLES)
                miss = np.array([inner, outer])
            else:
                miss = np.asarray(getattr(light, name) - getattr(true, name))
            found[index, name] = np.atleast_1d(miss), np.atleast_1d(error) / parts
    return found
