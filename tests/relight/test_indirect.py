"""Light reflected by other surfaces, against a plain loop over points."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    PointLight,
    SpotLight,
    Transfer,
    relight,
)
from tests.helpers.quick import check_slopes


RNG = np.random.default_rng(0)
HEIGHT, WIDTH, RANK, POINTS = 3, 4, 2, 5
SHADER = np.array([[0, 1, 2, -1]] * 3)
IMAGE = RNG.uniform(0.1, 1, (HEIGHT, WIDTH, 3))
CACHE = GBuffer(
    **dict.fromkeys(("color", "ambient", "specular", "normal"), np.ones((HEIGHT, WIDTH, 3))),
    diffuse=IMAGE,
    shader=SHADER,
    depth=np.ones((HEIGHT, WIDTH)),
    roughness=np.ones((HEIGHT, WIDTH)),
)
NORMAL = RNG.normal(size=(POINTS, 3))
TRANSFER = Transfer(
    receive=RNG.uniform(size=(HEIGHT, WIDTH, RANK)),
    send=RNG.normal(size=(RANK, POINTS)),
    position=RNG.normal(size=(POINTS, 3)),
    normal=NORMAL / np.linalg.norm(NORMAL, axis=1, keepdims=True),
    diffuse=RNG.uniform(size=(POINTS, 3)),
    exchange=RNG.uniform(size=(POINTS, POINTS)) / POINTS,
)
SPOT = SpotLight([0, 0, 4.0], [0, 0, -1.0], [3, 2, 1.0], 1.0, 1.2)
LIGHTS = [
    AmbientLight([1, 1, 1.0]),
    DirectionalLight([0.3, -1, 0.2], [1, 2, 3.0]),
    PointLight([0.5, 2, -1.0], [2, 1, 4.0]),
    SPOT,
]
NAME = "visibilities"
LIT = [None, RNG.uniform(size=POINTS), None, RNG.uniform(size=POINTS)]


def irradiance(light, place, normal):
    """What a point gets of a light; all of the points lie inside the spot's inner cone."""
    if isinstance(light, AmbientLight):
        return np.zeros(3)
    if isinstance(light, DirectionalLight):
        to_light = -np.asarray(light.direction)
        return np.asarray(light.color) * max(normal @ to_light / np.linalg.norm(to_light), 0)
    to_light = np.asarray(light.position) - place
    return np.asarray(light.color) * max(normal @ to_light, 0) / np.linalg.norm(to_light) ** 3


def test_is_the_sum_over_points():
    t, expected = TRANSFER, np.zeros((HEIGHT, WIDTH, 3))
    for j in range(POINTS):
        place, normal = np.asarray(t.position[j]), np.asarray(t.normal[j])
        axis = (np.asarray(SPOT.position) - place) / np.linalg.norm(SPOT.position - place)
        assert axis[2] > np.cos(1.0)
        for light, lit in zip(LIGHTS, LIT, strict=True):
            sent = np.asarray(t.diffuse[j]) * irradiance(light, place, normal)
            share = np.asarray(t.receive) @ np.asarray(t.send[:, j])
            expected += share[..., None] * sent * (1 if lit is None else lit[j])
    expected *= IMAGE * (SHADER >= 0)[..., None]
    assert np.abs(expected).max() > 0.1
    result = relight.indirect(CACHE, t, LIGHTS, visibilities=LIT)
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_further_bounces_are_the_sums_over_all_paths():
    """Of light, point after point, each to the next; pixels sum over the points."""
    t = jax.tree.map(np.asarray, TRANSFER)
    emitted = np.array(
        [t.diffuse[j] * irradiance(SPOT, t.position[j], t.normal[j]) for j in range(POINTS)]
    )
    matrix, paths, expected = np.asarray(t.exchange), emitted, emitted
    for bounces in (1, 2, 3):
        if bounces > 1:
            after = np.zeros_like(paths)
            for to, start in np.ndindex(POINTS, POINTS):
                after[to] += t.diffuse[to] * matrix[to, start] * paths[start]
            paths, expected = after, expected + after
        image = IMAGE * (SHADER >= 0)[..., None] * (t.receive @ (t.send @ expected))
        found = relight.indirect(CACHE, TRANSFER, [SPOT], bounces=bounces)
        np.testing.assert_allclose(found, image, rtol=1e-12)


def test_both_modes_match_differences_through_two_bounces():
    """In the pixels' and points' reflectance, the exchange, and the light."""

    def loss(diffuse, reflectance, exchange, position):
        cache = eqx.tree_at(lambda g: g.diffuse, CACHE, diffuse)
        fields = vars(TRANSFER) | {"diffuse": reflectance, "exchange": exchange}
        light = PointLight(position, [2, 1, 4.0])
        return jnp.sum(relight.indirect(cache, Transfer(**fields), [light], bounces=2) ** 2)

    at = CACHE.diffuse, TRANSFER.diffuse, TRANSFER.exchange, jnp.asarray([0.5, 2, -1.0])
    check_slopes(loss, at)


def test_no_lights_and_ambient_ones_bring_nothing():
    for lights in ([], LIGHTS[:1]):
        assert not np.asarray(relight.indirect(CACHE, TRANSFER, lights)).any()


def test_what_scene_visible_gives_is_lit():
    """Booleans are 0 and 1, and numbers beyond those no share."""
    lit = RNG.uniform(size=POINTS) < 0.5
    given = [None, lit, lit.tolist(), ~lit]
    as_numbers = [None, *(np.array(each, float) for each in given[1:])]
    np.testing.assert_array_equal(
        relight.indirect(CACHE, TRANSFER, LIGHTS, visibilities=given),
        relight.indirect(CACHE, TRANSFER, LIGHTS, visibilities=as_numbers),
    )
    indirect = inspect.unwrap(relight.indirect)
    with pytest.raises(ValueError, match=rf"`indirect\({NAME}=...\)\[1\]` must be in \[0, 1\]"):
        indirect(CACHE, TRANSFER, LIGHTS, visibilities=[None, 255.0 * lit, None, None])


def test_a_bad_pixel_stays_where_it_is():
    bad = eqx.tree_at(lambda g: g.diffuse, CACHE, CACHE.diffuse.at[1, 1].set(np.nan))
    image = np.asarray(relight.indirect(bad, TRANSFER, LIGHTS, visibilities=LIT))
    wrong = np.zeros((HEIGHT, WIDTH), bool)
    wrong[1, 1] = True
    np.testing.assert_array_equal(np.isnan(image).any(axis=-1), wrong)


def test_errors_name_the_argument():
    indirect = inspect.unwrap(relight.indirect)
    small = Transfer(*(v[:2] if i == 0 else v for i, v in enumerate(vars(TRANSFER).values())))
    once = Transfer(**vars(TRANSFER) | {"exchange": None})
    for arguments, options, message in (
        ((CACHE, small, LIGHTS), {}, r"`indirect\(transfer\)` must be of the cache's height"),
        ((CACHE, TRANSFER, [SPOT]), {"bounces": 0}, r"`indirect\(bounces=...\)` must be"),
        ((CACHE, once, [SPOT]), {"bounces": 2}, r"`indirect\(bounces=...\)` must be 1 for a"),
        ((CACHE, TRANSFER, SPOT), {}, r"`indirect\(lights\)` must be a sequence of lights"),
        ((CACHE, TRANSFER, [1]), {}, r"`indirect\(lights\[0\]\)` must be one of Ambient"),
        (
            (CACHE, TRANSFER, LIGHTS),
            {"visibilities": [None]},
            r"`indirect\(visibilities=...\)` must hold",
        ),
        (
            (CACHE, TRANSFER, [SPOT]),
            {"visibilities": [np.ones(3)]},
            r"`indirect\(visibilities=...\)\[0\]` must",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            indirect(*arguments, **options)
