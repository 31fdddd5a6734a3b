"""The size of an area light, from the penumbra of its shadow.

References are sums over many points of the light, each with its own hard shadow, of a plate
over a floor: in closed form, without a shadow map.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    fit,
    relight,
    shadow,
)


SIZE, TEXELS = 40, 96
FLOOR, PLATE = 4.0, 2.5  # Depths, in scene units; the camera and the lights look along z.
CORNERS = np.array([[-0.55, -0.4], [0.45, 0.6]])  # Of the plate: least and most x, y.
CAMERA = OrthographicCamera(SIZE / 4, [SIZE / 2, SIZE / 2], np.eye(4))
# Where the maps were made: beside the lamp and the sun that are to be found.
AT, TOWARDS = np.array([0.02, 0.03, 0.04]), np.array([0.0, 0.0, 1.0])
LAMP: Any = PointLight([0.1, -0.06, 0.0], [8.0, 7.0, 5.0], 0.4)
SUN: Any = DirectionalLight([0.06, -0.04, 1.0], [1.0, 0.9, 0.7], 0.2)


@functools.cache
def floor(dtype=np.float64):
    white, flat = np.ones((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE))
    normal = white * np.array([0, 0, -1])
    images = 0 * white, 0.7 * white, 0 * white, normal, flat + FLOOR, flat + 1
    ambient, diffuse, specular, normal, depth, roughness = (
        each.astype(dtype) for each in images
    )
    return GBuffer(
        diffuse, flat.astype(int), ambient, diffuse, specular, normal, depth, roughness
    )


def is_lit(light, plate=True):
    """Whether each pixel sees a point light or a sun: its ray misses the plate."""
    along = (np.arange(SIZE) + 0.5 - SIZE / 2) / CAMERA.pixels_per_unit
    point = np.stack([*np.meshgrid(along, along), np.full((SIZE, SIZE), FLOOR)], axis=-1)
    if isinstance(light, DirectionalLight):
        way = -np.asarray(light.direction)
    else:
        way = np.asarray(light.position) - point
    crossing = point + way * ((PLATE - FLOOR) / way[..., 2:])
    is_inside = (crossing[..., :2] > CORNERS[0]) & (crossing[..., :2] < CORNERS[1])
    return ~is_inside.all(axis=-1) | (not plate)


def parts(light: Any, count, is_round=False):
    """Lights without an extent, in place of one with: of a square or of a disc."""
    # Sheared both ways, so that no two points cross an edge along an axis at once.
    i, j = np.mgrid[:count, :count] + 0.5
    across = np.stack([i + j / count - 0.5, j + i / count - 0.5], axis=-1).reshape(-1, 2)
    across = across / count - 0.5
    if is_round:
        across = across[np.hypot(*across.T) <= 0.5]
    color, size = light.color / len(across), light.light_size
    for x, y in across:
        if isinstance(light, DirectionalLight):
            wide = 2 * np.tan(size / 2)
            yield DirectionalLight(light.direction + wide * np.array([x, y, 0.0]), color)
        else:
            place = light.position + size * np.array([x, y, 0.0])
            yield PointLight(place, color)


def photograph(light, plate=True, is_round=False):
    """The floor under 16 x 16 points of a light."""
    return sum(
        np.asarray(relight.shade(floor(), CAMERA, one, is_lit(one, plate)))
        for one in parts(light, 16, is_round)
    )


def light_camera(kind):
    if kind is DirectionalLight:
        pose = np.eye(4)
        return OrthographicCamera(TEXELS / 4, [TEXELS / 2, TEXELS / 2], pose)
    pose = np.eye(4)
    pose[:3, 3] = AT
    inside = [[TEXELS, 0, TEXELS / 2], [0, TEXELS, TEXELS / 2], [0, 0, 1.0]]
    return PinholeCamera(inside, pose)


def shadow_map(camera):
    """Depths of the plate and the floor, along the rays of a map's texels."""
    x, y = np.meshgrid(*2 * [np.arange(TEXELS) + 0.5])
    at = camera.unproject(np.stack([x, y], axis=-1), np.full((TEXELS, TEXELS), PLATE - AT[2]))
    if isinstance(camera, OrthographicCamera):
        at = camera.unproject(np.stack([x, y], axis=-1), np.full((TEXELS, TEXELS), PLATE))
    above = np.asarray(at)[..., :2]
    over = ((above > CORNERS[0]) & (above < CORNERS[1])).all(axis=-1)
    return np.where(over, PLATE, FLOOR) - np.asarray(camera.world_from_camera)[2, 3]


@functools.cache
def moving(kind, plate=True):
    """The shadow of the map beside the light."""
    camera = light_camera(kind)
    depths = shadow_map(camera)
    if not plate:
        depths = np.full_like(depths, depths.max())
    return shadow.MovingShadow(depths, camera, floor(), CAMERA, softness=0.1, size=15)


START = {
    PointLight: PointLight([0.0, 0.05, 0.1], [1, 1, 1], 0.2),
    DirectionalLight: DirectionalLight([0.0, 0.0, 1.0], [1, 1, 1], 0.1),
}


def found(image, kind, start=None, **options) -> Any:
    given = {"visibilities": [moving(kind)], "loss": "squares", "throw": False} | options
    return fit.lights(image, floor(), CAMERA, [start or START[kind]], **given)


@pytest.mark.parametrize("light", [LAMP, SUN], ids=["lamp", "sun"])
def test_its_shadow_is_that_of_many_points(light):
    """But for edges, which the map knows to a texel: a sixth of the penumbra here."""
    bare = type(light)(**vars(light) | {"light_size": None})
    truth = photograph(light) / np.asarray(relight.shade(floor(), CAMERA, bare))
    off = np.asarray(moving(type(light))(light)) - truth[..., 0]
    assert np.abs(off).max() < 0.1 and np.sqrt(np.mean(off**2)) < 0.015
    hard = np.asarray(is_lit(light), float) - truth[..., 0]
    assert np.sqrt(np.mean(hard**2)) > 0.05


@pytest.mark.parametrize("light", [LAMP, SUN], ids=["lamp", "sun"])
@pytest.mark.full
def test_derivatives_of_the_shadow_against_differences(light):
    """In the size, and in where a light with a size is; off the kinks of round numbers."""
    soft, name = moving(type(light)), "direction" if light is SUN else "position"
    weight = np.random.default_rng(0).normal(size=(SIZE, SIZE))

    def total(numbers):
        where = {"light_size": numbers[3], name: numbers[:3]}
        return jnp.sum(weight * soft(type(light)(**vars(light) | where)))

    numbers = jnp.append(getattr(light, name), light.light_size)
    numbers = numbers + np.array([0.00713, -0.00351, 0.01171, 0.00319])
    at = jax.jit(jax.value_and_grad(total))
    gradient = at(numbers)[1]
    forward = jax.jit(jax.jacfwd(total))(numbers)
    np.testing.assert_allclose(forward, gradient, rtol=1e-9, atol=1e-9)
    ends = [[at(numbers + sign * 1e-7 * e)[0] for sign in (1, -1)] for e in np.eye(4)]
    slopes = [(high - low) / 2e-7 for high, low in ends]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-5, atol=1e-5)
    assert abs(gradient[3]) > 0.1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.full
def test_colors_and_size_by_pcss(dtype):
    """Where the lamp stands is known, so that one map does. It finds 0.412 for 0.4."""
    at = PointLight(AT, LAMP.color, LAMP.light_size)
    camera = light_camera(PointLight)
    depths = np.asarray(shadow_map(camera), dtype)
    receivers = shadow.receivers(floor(dtype).depth, CAMERA, camera)
    soft = lambda light: shadow.pcss(
        depths, receivers, camera, size=15, light_size=light.light_size
    )
    given = {"visibilities": [soft], "parameters": ["color", "light_size"]}
    start = PointLight(AT, np.ones(3), 0.2)
    image = photograph(at)
    result: Any = fit.lights(image, floor(dtype), CAMERA, [start], loss="squares", **given)
    assert result.success
    np.testing.assert_allclose(result.lights[0].light_size, 0.4, rtol=0.04)
    np.testing.assert_allclose(result.lights[0].color, LAMP.color, rtol=0.005)


@pytest.mark.parametrize("light", [LAMP, SUN], ids=["lamp", "sun"])
@pytest.mark.full
def test_place_colors_and_size(light):
    result = found(photograph(light), type(light))
    assert result.success, result.doubt
    (fitted,), (errors,) = result.lights, result.standard_errors
    np.testing.assert_allclose(fitted.light_size, light.light_size, rtol=0.01)
    assert abs(fitted.light_size - light.light_size) < 4 * errors["light_size"]
    np.testing.assert_allclose(fitted.color, light.color, rtol=0.005)


@pytest.mark.full
def test_a_round_light_is_found_as_a_square_of_less():
    result = found(photograph(LAMP, is_round=True), PointLight)
    assert result.success
    np.testing.assert_allclose(result.lights[0].light_size / 0.4, 0.85, atol=0.01)


@pytest.mark.parametrize("case", ["no shadow", 0.01, 0.05, 0.1, "wide"])
@pytest.mark.full
def test_a_penumbra_that_cannot_be_seen_is_said(case):
    """Nothing over the floor; less than a pixel and two texels; cut to the kernel."""
    has_plate = case != "no shadow"
    size = {"no shadow": 0.4, "wide": 2.0}.get(case, case)
    truth = PointLight(LAMP.position, LAMP.color, size)
    start = truth if case == "wide" else START[PointLight]
    soft = moving(PointLight, plate=has_plate)
    image = photograph(truth, plate=has_plate)
    result = found(image, PointLight, start, visibilities=[soft])
    assert not result.success, (result.lights[0].light_size, result.standard_errors)
    assert result.unsure[0]["light_size"], (result.doubt, result.standard_errors)


@pytest.mark.full
def test_a_size_that_no_shadow_reads_is_said():
    parameters = ["color", "light_size"]
    image = photograph(LAMP, plate=False)
    result = found(image, PointLight, visibilities=None, parameters=parameters)
    assert not result.success
    assert np.isinf(result.standard_errors[0]["light_size"])


@pytest.mark.parametrize("size", [0.0, -0.1, float("nan")])
@pytest.mark.parametrize("make", [DirectionalLight, PointLight])
def test_a_size_is_positive(make, size):
    with pytest.raises(ValueError, match=r"light_size"):
        make([0.0, 0, 1], [1.0, 1, 1], light_size=size)
