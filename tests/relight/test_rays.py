"""Mirrored and refracted rays, and their shares, against angles; caches along rays."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import DirectionalLight, GBuffer, PinholeCamera, PointLight, relight
from jaxfx.camera import Rays
from tests.helpers.quick import check_slopes


RNG = np.random.default_rng(0)
SIZE = (3, 4)
CAMERA = PinholeCamera.from_fov(1.2, height=SIZE[0], width=SIZE[1])
TOWARD = np.asarray(CAMERA.rays(height=SIZE[0], width=SIZE[1]).directions)
NORMAL = RNG.normal(size=(*SIZE, 3))
NORMAL /= np.linalg.norm(NORMAL, axis=-1, keepdims=True)
NORMAL *= -np.sign((NORMAL * TOWARD).sum(axis=-1, keepdims=True))
IMAGES = {name: RNG.uniform(0.1, 1, (*SIZE, 3)) for name in ("color", "ambient", "diffuse")}
CACHE = GBuffer(
    **IMAGES,
    specular=RNG.uniform(0.1, 0.9, (*SIZE, 3)),
    normal=NORMAL,
    shader=np.array([[3, 2, 3, -1]] * 3),
    depth=RNG.uniform(1, 2, SIZE),
    roughness=RNG.uniform(0.3, 0.9, SIZE),
)
SHOWN = np.asarray(CACHE.shader) >= 0


def angle(i, j):
    """Between the normal and the ray that came."""
    return np.arccos(-NORMAL[i, j] @ TOWARD[i, j])


@pytest.mark.usefixtures("optimised")
def test_mirrored_rays_leave_by_the_angle_they_came_by():
    rays = jax.device_get(relight.mirrored(CACHE, CAMERA))
    points = np.asarray(CAMERA.points(CACHE.depth))
    for i, j in np.ndindex(*SIZE):
        if not SHOWN[i, j]:
            assert not np.any(rays.origins[i, j]) and not np.any(rays.directions[i, j])
            continue
        out = rays.directions[i, j]
        np.testing.assert_allclose(rays.origins[i, j], points[i, j], rtol=1e-12)
        assert np.arccos(out @ NORMAL[i, j]) == pytest.approx(angle(i, j), abs=1e-9)
        assert np.linalg.det([out, TOWARD[i, j], NORMAL[i, j]]) == pytest.approx(0, abs=1e-12)
        assert np.linalg.norm(out) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("index", [1.5, 0.8])
def test_refracted_rays_obey_snell_and_fresnel(index):
    rays = jax.device_get(relight.refracted(CACHE, CAMERA, index=index))
    share = np.asarray(relight.fresnel(CACHE, CAMERA, index=index))
    total = 0
    for i, j in np.argwhere(SHOWN):
        before, out = angle(i, j), rays.directions[i, j]
        if np.sin(before) > index:
            total += 1
            assert not out.any() and (share[i, j] == 1).all()
            continue
        after = np.arcsin(np.sin(before) / index)
        assert np.arccos(-out @ NORMAL[i, j]) == pytest.approx(after, abs=1e-9)
        assert np.linalg.det([out, TOWARD[i, j], NORMAL[i, j]]) == pytest.approx(0, abs=1e-12)
        across = np.sin(before - after) / np.sin(before + after)
        along = np.tan(before - after) / np.tan(before + after)
        np.testing.assert_allclose(share[i, j], (across**2 + along**2) / 2, rtol=1e-9)
    assert (total > 0) == (index < 1)
    np.testing.assert_array_equal(share[~SHOWN], 0)


def test_without_an_index_the_share_is_schlicks():
    share = np.asarray(relight.fresnel(CACHE, CAMERA))
    for i, j in np.argwhere(SHOWN):
        straight = np.asarray(CACHE.specular)[i, j]
        expected = straight + (1 - straight) * (1 - np.cos(angle(i, j))) ** 5
        np.testing.assert_allclose(share[i, j], expected, rtol=1e-12)


def test_a_cache_along_rays_is_lit_as_the_cameras_own():
    """The same surface, its depth as a distance; under every shader, in both forms."""
    rays = CAMERA.rays(height=SIZE[0], width=SIZE[1])
    axis = np.asarray(CAMERA.world_from_camera)[:3, 2]
    distance = np.asarray(CACHE.depth) / (TOWARD @ axis)
    along = eqx.tree_at(lambda g: g.depth, CACHE, distance)
    lights = [
        PointLight([0.3, -1, -0.5], [2, 3, 1]),
        DirectionalLight([0.2, 0.4, 1], [1, 1, 2]),
    ]
    expected = relight.render(CACHE, CAMERA, lights)
    np.testing.assert_allclose(relight.render(along, rays, lights), expected, rtol=1e-9)
    state = relight.start(along, rays, lights)
    np.testing.assert_allclose(state.image, expected, rtol=1e-9)


@pytest.mark.parametrize("index", [1.5, 0.8])
def test_both_modes_match_differences(index):
    """In normals, depth and index; also where some rays are reflected as a whole."""
    weight = RNG.normal(size=(5, *SIZE, 3))

    def loss(normal, depth, index):
        cache = eqx.tree_at(lambda g: (g.normal, g.depth), CACHE, (normal, depth))
        shares = relight.fresnel(cache, CAMERA, index=index)
        fields = *relight.mirrored(cache, CAMERA), shares
        fields += (*relight.refracted(cache, CAMERA, index=index),)
        return sum(jnp.sum(a * b) for a, b in zip(weight, fields, strict=True))

    check_slopes(loss, (CACHE.normal, CACHE.depth, np.array(index)))


def test_derivatives_are_finite_where_refraction_ends():
    turn = np.array([[[0.6, 0.0, -0.8]]])

    def loss(normal, index):
        toward = Rays(jnp.zeros((1, 1, 3)), jnp.array([[[0.0, 0, 1]]]))
        wall = jax.tree.map(lambda x: x[:1, :1], CACHE)
        cache = eqx.tree_at(lambda g: g.normal, wall, normal)
        share = relight.fresnel(cache, toward, index=index)
        return jnp.sum(share) + jnp.sum(relight.refracted(cache, toward, index=index)[1])

    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))
    for index in (0.6, 1.0):
        assert all(np.isfinite(slope).all() for slope in slopes(turn, np.array(index)))


def test_errors_name_their_argument():
    refracted, mirrored = map(inspect.unwrap, (relight.refracted, relight.mirrored))
    for index in (0.0, np.nan, -1.0):
        with pytest.raises(ValueError, match=r"^`refracted\(index=...\)` must be positive"):
            refracted(CACHE, CAMERA, index=index)
    with pytest.raises(ValueError, match=r"^`refracted\(index=...\)` must have shape"):
        refracted(CACHE, CAMERA, index=np.ones(3))
    rays = Rays(jnp.zeros((2, 2, 3)), jnp.ones((2, 2, 3)))
    with pytest.raises(ValueError, match=r"^`mirrored\(camera.origins\)` must have shape"):
        mirrored(CACHE, rays)
