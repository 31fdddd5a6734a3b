"""Shadows from all around: a floor beside a wall against the wall's own closed form."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import sph_harm_y
from trimesh import Trimesh, util

from jaxfx import (
    EnvironmentLight,
    PinholeCamera,
    PointLight,
    SphericalHarmonicsLight,
    relight,
    scene,
)
from tests.helpers.quick import check_slopes
from tests.test_environment import TURN, clouds, directions, lamps


pytestmark = pytest.mark.skipif(
    scene.embree.problem() is not None, reason="Embree does not work on this machine."
)
SIZE = {"height": 6, "width": 8}


def rectangle(corners):
    return Trimesh(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], process=False)


def functions(way):
    """The sixteen real functions, from SciPy's complex ones."""
    x, y, z = np.moveaxis(way, -1, 0)
    down, around = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    found = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), down, around)
            part = value.imag if order < 0 else value.real
            found.append(part * ((-1) ** order * np.sqrt(2) if order else 1))
    return np.stack(found, axis=-1)


def floor_and_wall():
    """A floor at y = 0, a wall at z = -1, three high and four wide; its cache and camera."""
    floor = rectangle([[-5, 0, 5], [5, 0, 5], [5, 0, -5], [-5, 0, -5]])
    wall = rectangle([[-2, 0, -1], [2, 0, -1], [2, 3, -1], [-2, 3, -1]])
    camera = PinholeCamera.look_at(
        [0.3, 3, 1.5], [0.2, 0, 0.2], up=[0, 1, 0], fov_y=0.6, **SIZE
    )
    mesh = scene.from_trimesh(util.concatenate([floor, wall]))
    gbuffer = scene.gbuffer(mesh, camera, **SIZE, backend="embree")
    np.testing.assert_allclose(gbuffer.normal[..., 1], 1, atol=1e-6)  # Of the floor alone.
    return mesh, gbuffer, camera


stage = pytest.fixture(scope="module")(floor_and_wall)


def arrives(camera, gbuffer, way):
    """The cosine over pi by which light from each direction falls on each pixel's floor."""
    position = np.asarray(camera.points(np.asarray(gbuffer.depth, float))).reshape(-1, 1, 3)
    with np.errstate(divide="ignore"):
        distance = (-1 - position[..., 2]) / way[:, 2]
    where = position + distance[..., None] * way
    is_blocked = (distance > 0) & (np.abs(where[..., 0]) < 2)
    is_blocked &= (where[..., 1] > 0) & (where[..., 1] < 3)
    return np.where(is_blocked, 0, np.maximum(way[:, 1], 0) / np.pi)


def traced(gbuffer, camera, radiance, turn):
    """The floor by the sum over all directions."""
    way, solid_angle = (part.reshape(-1, *part.shape[2:]) for part in directions(96))
    weights = arrives(camera, gbuffer, way) * solid_angle
    return np.asarray(gbuffer.diffuse) * (weights @ radiance(way @ turn)).reshape(6, 8, 3)


def test_it_is_the_integrals_over_what_is_free(stage):
    mesh, gbuffer, camera = stage
    way, solid_angle = (part.reshape(-1, *part.shape[2:]) for part in directions(128))
    expected = (arrives(camera, gbuffer, way) * solid_angle) @ functions(way)
    many = scene.occlusion(mesh, gbuffer, camera, ray_count=4096)
    found = np.asarray(many).reshape(-1, 16)
    np.testing.assert_allclose(found, expected, atol=5e-3)
    # Fewer rays and numbers: the same to their noise, and the first of them.
    few = scene.occlusion(mesh, gbuffer, camera, ray_count=256, degree=2, seed=3)
    np.testing.assert_allclose(few, many[..., :9], atol=0.04)


def test_without_an_occluder_there_is_no_noise(stage):
    _, gbuffer, camera = stage
    floor = scene.from_trimesh(rectangle([[-5, 0, 5], [5, 0, 5], [5, 0, -5], [-5, 0, -5]]))
    free = scene.occlusion(floor, gbuffer, camera, ray_count=8)
    left = np.repeat([1, 2 / 3, 1 / 4, 0], [1, 3, 5, 7])
    expected = functions(np.array([0.0, 1, 0])) * left
    np.testing.assert_allclose(free, np.broadcast_to(expected, free.shape), atol=1e-6)
    light = SphericalHarmonicsLight(np.random.default_rng(0).normal(size=(9, 3)))
    shadowed = relight.shade(gbuffer, camera, light, free)
    plain = relight.shade(gbuffer, camera, light)
    np.testing.assert_allclose(shadowed, plain, atol=1e-5)


@pytest.mark.parametrize(("radiance", "least"), [(clouds, 35), (lamps, 30)])
def test_light_from_all_around_casts_shadows(stage, radiance, least):
    """Against the sum over all directions, the map turned or not: one trace, two edits."""
    mesh, gbuffer, camera = stage
    occlusion = scene.occlusion(mesh, gbuffer, camera, ray_count=1024)
    light = EnvironmentLight(radiance(directions(32)[0]))
    state = relight.start(gbuffer, camera, [light], visibilities=[occlusion])
    for turn in (np.eye(3), TURN):
        state = state.edit(0, light.turned(turn))
        expected = traced(gbuffer, camera, radiance, turn)
        error = np.asarray(state.image) - expected
        found = 10 * np.log10(expected.max() ** 2 / np.mean(error**2))
        print(f"{radiance.__name__} {found:.1f} dB")
        assert found > least


@pytest.mark.full
def test_many_lights_edits_and_ggx_agree(stage):
    mesh, gbuffer, camera = stage
    occlusion = np.asarray(scene.occlusion(mesh, gbuffer, camera, ray_count=16), float)
    fields = vars(gbuffer) | {
        "shader": np.arange(48).reshape(6, 8) % 5,
        "specular": np.full((6, 8, 3), 0.3),
        "roughness": np.full((6, 8), 0.4),
    }
    gbuffer = jax.tree.map(jnp.asarray, type(gbuffer)(**fields))
    light = EnvironmentLight(clouds(directions(8)[0]))
    around = SphericalHarmonicsLight(np.random.default_rng(1).normal(size=(9, 3)))
    lights = [light, around, light.turned(TURN), around, PointLight([0, 2, 0], [1, 1, 1])]
    share = np.full((6, 8), 0.5)
    shadows = [occlusion, occlusion[..., :9], share, None, share]
    each = [relight.shade(gbuffer, camera, *pair) for pair in zip(lights, shadows, strict=True)]
    image = relight.render(gbuffer, camera, lights, visibilities=shadows)
    np.testing.assert_allclose(image, sum(each), rtol=1e-4, atol=1e-5)
    state = relight.start(gbuffer, camera, lights[1:], visibilities=shadows[1:])
    state = state.add(light, occlusion).edit(0, around)
    np.testing.assert_allclose(state.image, image, rtol=1e-4, atol=1e-5)
    # A highlight is as bright as the matt surface is under a white sky.
    white = EnvironmentLight(np.ones((4, 8, 3)))
    metal = type(gbuffer)(**fields | {"shader": np.full((6, 8), 3), "diffuse": 0 * each[0]})
    bright = relight.shade(metal, camera, white)
    ratio = relight.shade(metal, camera, white, occlusion) / bright
    openness = occlusion[..., :1] * np.sqrt(4 * np.pi) * np.ones(3)
    np.testing.assert_allclose(ratio, openness, rtol=1e-4)


def test_both_modes_equal_differences(stage):
    _, gbuffer, camera = stage
    rng = np.random.default_rng(2)
    weight, image = rng.normal(size=(6, 8, 3)), rng.uniform(size=(4, 8, 3))

    def score(image, angle, color, visibility):
        c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros(())
        rows = [[c, s, zero], [-s, c, zero], [zero, zero, 1 + zero]]
        turn = jnp.stack([jnp.stack(row) for row in rows])
        light = EnvironmentLight(image, turn, color)
        shown = relight.shade(gbuffer, camera, light, visibility)
        return jnp.sum(weight * shown)

    gbuffer = jax.tree.map(
        lambda leaf: leaf if leaf.dtype == np.int32 else leaf.astype(float), gbuffer
    )
    visibility = rng.normal(size=(6, 8, 16))
    arguments = image, 0.4, np.array([1.0, 2.0, 0.5]), visibility
    arguments = jax.tree.map(jnp.asarray, arguments)
    check_slopes(score, arguments, rtol=1e-6, atol=1e-6, eps=1e-5)


def test_errors_name_the_argument(stage):
    mesh, gbuffer, camera = stage
    shade, occlusion = inspect.unwrap(relight.shade), inspect.unwrap(scene.occlusion)
    lamp, around = PointLight([0, 2, 0], [1, 1, 1]), SphericalHarmonicsLight(np.ones((9, 3)))
    with pytest.raises(
        ValueError, match=r"`shade\(visibility\)` must have shape .* PointLight"
    ):
        shade(gbuffer, camera, lamp, np.ones((6, 8, 9)))
    with pytest.raises(ValueError, match=r"`shade\(visibility\)` must have .* 9 or 16"):
        shade(gbuffer, camera, around, np.ones((6, 8, 4)))
    with pytest.raises(ValueError, match=r"`scene.occlusion\(degree=...\)` must be 2 or 3"):
        occlusion(mesh, gbuffer, camera, degree=4)
    with pytest.raises(ValueError, match=r"`scene.occlusion\(ray_count=...\)` must be"):
        occlusion(mesh, gbuffer, camera, ray_count=0)
    state = relight.start(gbuffer, camera, [around], visibilities=[np.ones((6, 8, 9))])
    with pytest.raises(ValueError, match=r"`edit\(visibility\)` must have shape"):
        state.edit(0, lamp)
