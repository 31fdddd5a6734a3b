"""The bias that is left out: planes are lit, shadows keep their feet, and a 0 given is 0."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    DirectionalLight,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SpotLight,
    budget,
    shadow,
)
from jaxfx._sampling import pixel_centers

from .conftest import naive_pcf


SIDE, MAP, WHITE = 40, 48, [1.0, 1.0, 1.0]
POINT = np.array([0.0, 1.0, 4.0])
LIGHTS = {
    "overhead sun": DirectionalLight([0.0, 1.0, 0.0], WHITE),
    "low sun": DirectionalLight([1.0, 0.3, 0.2], WHITE),
    "spot": SpotLight([0.5, -3.0, 3.0], [0.0, 1.0, 0.2], WHITE, 0.5, 0.7),
    "lamp": PointLight([0.7, -1.0, 3.5], WHITE),
}
METHODS = {
    "pcf": shadow.pcf,
    "pcf, tent": ft.partial(shadow.pcf, kernel="tent"),
    "pcf, soft Gaussian": ft.partial(shadow.pcf, kernel="gaussian", softness=0.3),
    "edge_pcf": shadow.edge_pcf,
    "edge_pcf, screen": ft.partial(shadow.edge_pcf, edges="screen", dilation=2),
    "prefiltered": shadow.prefiltered,
    "variance": shadow.variance,
}


def plane_depth(camera, normal, side, dtype):
    """The depth at which each pixel's ray meets the plane; inf where it does not."""
    centers = pixel_centers(side, side)
    ones = jnp.ones((side, side))
    start = np.asarray(camera.unproject(centers, 0 * ones))
    ray = np.asarray(camera.unproject(centers, ones)) - start
    with np.errstate(divide="ignore"):
        depth = ((POINT - start) @ normal) / (ray @ normal)
    return np.where(depth > 0, depth, np.inf).astype(dtype)


def on_a_plane(light, tilt, dtype, eye=None, turn=0.4):
    """Its map and receivers, the light's first camera, and where it meets the plane steeply."""
    level = np.sin(tilt)
    normal = np.array([level * np.cos(turn), -np.cos(tilt), level * np.sin(turn)])
    eye = eye or PinholeCamera.look_at(
        [0, -2, 0], [0, 1, 4], up=[0, -1, 0], fov_y=0.7, height=SIDE, width=SIDE
    )
    cameras = shadow.light_cameras(
        light, map_size=MAP, scene_center=POINT, scene_radius=3.0, margin=11
    )
    maps = [plane_depth(camera, normal, MAP, dtype) for camera in cameras]
    shadow_map = np.concatenate(maps, axis=1)
    depth = plane_depth(eye, normal, SIDE, dtype)
    seen = shadow.receivers(depth, eye, cameras)
    known = jnp.asarray(np.where(depth < 99, depth, 1), float)
    points = np.asarray(eye.unproject(pixel_centers(SIDE, SIDE), known))
    away = (
        np.broadcast_to(light.direction, points.shape)
        if isinstance(light, DirectionalLight)
        else points - np.asarray(light.position)
    )
    sine = abs(away @ normal) / np.linalg.norm(away, axis=-1)
    margin = min(10, MAP // 2)
    inside = (seen.v > margin) & (seen.v < MAP - margin) & (depth < 99)
    return shadow_map, seen, cameras[0], np.asarray(inside) & (sine > 0.02)


@pytest.mark.parametrize("tilt", [0.0, 0.8, 1.2])
@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.full
def test_a_plane_is_lit_by_every_method(name, tilt):
    """In float32, whose rounding tells nearest from next; the sine of its grazing is 0.02."""
    shadow_map, seen, camera, inside = on_a_plane(LIGHTS[name], tilt, np.float32)
    assert inside.mean() > 0.3
    assert np.asarray(shadow.hard(shadow_map, seen))[inside].min() == 1
    pcss = lambda *data, **how: shadow.pcss(*data, camera, light_size=0.3, **how)
    for method, call in (METHODS | {"pcss": pcss}).items():
        for size in range(1, 22, 2) if method == "pcf" else (3, 21):
            visible = np.asarray(call(shadow_map, seen, size=size))[inside]
            assert visible.min() >= 1 - 1e-6, (method, size)


@pytest.mark.full
def test_receivers_between_texels_are_lit_too():
    """Pixels' centres on the borders of texels, where a filter's far corner is farthest."""
    up = PinholeCamera.look_at([0, -2, 4], POINT, up=[0, 0, 1], fov_y=1, height=4, width=4)
    light = DirectionalLight([0.0, 1.0, 0.0], WHITE)
    (camera,) = shadow.light_cameras(
        light, map_size=MAP, scene_center=POINT, scene_radius=3.0, margin=11
    )
    middle = [SIDE / 2 + 0.5] * 2
    eye = OrthographicCamera(camera.pixels_per_unit, middle, up.world_from_camera)
    for dtype, size in ((np.float32, 5), (np.float64, 5), (np.float32, 21)):
        is_tight = False
        for turn in np.pi / 4 + np.arange(4) * np.pi / 2:
            shadow_map, seen, _, inside = on_a_plane(light, 1.0, dtype, eye, turn)
            assert np.abs(seen.u - np.round(seen.u)).max() < 1e-4
            visible = np.asarray(shadow.pcf(shadow_map, seen, size=size))
            assert (visible[inside] == 1).all()
            less = shadow.pcf(shadow_map, seen, size=size, slope_bias=size / 2 - 0.1)
            is_tight |= bool(np.asarray(less)[inside].min() < 1)
        assert is_tight


def test_0_said_outright_is_0(case):
    for given in ({"bias": 0.0}, {"slope_bias": 0.0}, {"bias": 0.0, "slope_bias": 0.0}):
        for size in (1, 5):
            visible = shadow.pcf(*case, size=size, **given)
            np.testing.assert_allclose(visible, naive_pcf(*case, size), atol=1e-15)
    # Where one is given, the other is 0.
    visible = shadow.pcf(*case, size=5, slope_bias=0.5)
    np.testing.assert_allclose(visible, naive_pcf(*case, 5, 0.0, 0.5), atol=1e-15)


@pytest.mark.full
def test_without_a_bias_a_plane_shadows_itself():
    shadow_map, seen, _, inside = on_a_plane(LIGHTS["low sun"], 0.8, np.float32)
    for size in (3, 9):
        dark = np.asarray(shadow.pcf(shadow_map, seen, size=size, bias=0.0))[inside] < 1
        assert dark.mean() > 0.9


@pytest.mark.parametrize("steep", [0.3, 3.0])
@pytest.mark.parametrize("wall", [0.0, 2.0])
@pytest.mark.parametrize("turn", [0.0, np.pi / 4])
def test_a_shadow_loses_its_foot_by_less_than_the_filter(steep, wall, turn):
    """A wall stands on a floor: the share of its texels, but for receivers near the contact.

    Seen by parallel light, the floor's depth grows by `steep` a texel beyond the contact; the
    wall, which hides it there, comes nearer to the light by `wall` a texel.
    """
    x, y = np.meshgrid(*2 * (np.arange(60) + 0.5,))
    ahead = lambda u, v: np.cos(turn) * (u - 24) + np.sin(turn) * (v - 24)
    floor = lambda u, v: 100 + steep * ahead(u, v)
    is_wall = (ahead(x, y) > 0) & (ahead(x, y) < 24)
    shadow_map = np.where(is_wall, 100 - wall * ahead(x, y), floor(x, y))
    u, v = np.meshgrid(np.linspace(10, 40, 61) + 0.013, np.linspace(10, 40, 13) + 0.007)
    along_both = np.cos(turn) + np.sin(turn)
    slope = np.full_like(u, steep * along_both)
    seen = shadow.Receivers(*map(jnp.asarray, (u, v, floor(u, v), slope)))
    for size in (1, 5, 9):
        share = naive_pcf(np.where(is_wall, 0.0, np.inf), seen, size)
        visible = np.asarray(shadow.pcf(shadow_map, seen, size=size))
        lost = np.abs(visible - share) > 1e-12
        assert np.abs(ahead(u, v))[lost].max(initial=0) <= along_both * size / 2 + 0.5
        assert share.min() == visible.min() == 0


@pytest.mark.parametrize(
    "method",
    [
        ft.partial(shadow.pcf, kernel="tent"),
        ft.partial(shadow.edge_pcf, kernel="tent"),
        lambda *data, **how: shadow.pcss(
            *data, OrthographicCamera(2.0, [8, 7], np.eye(4)), light_size=0.8, **how
        ),
    ],
)
@pytest.mark.full
def test_derivatives_by_the_default_are_differences(case, method):
    shadow_map, receivers = jax.tree.map(jnp.asarray, case)
    rng = np.random.default_rng(3)

    @jax.jit
    def loss(at):
        shadow_map, receivers, softness = at
        return jnp.sum(method(shadow_map, receivers, size=3, softness=softness) ** 2)

    at = (shadow_map, receivers, jnp.asarray(0.4))
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), at)
    moved = lambda h: jax.tree.map(lambda x, d: jnp.where(x < jnp.inf, x + h * d, x), at, along)
    expected = float(loss(moved(1e-7)) - loss(moved(-1e-7))) / 2e-7
    assert float(jax.jvp(loss, (at,), (along,))[1]) == pytest.approx(expected, rel=1e-5)
    pulled = sum(
        float(jnp.vdot(x, d))
        for x, d in zip(*map(jax.tree.leaves, (jax.grad(loss)(at), along)), strict=True)
    )
    assert pulled == pytest.approx(expected, rel=1e-5)


@pytest.mark.full
def test_a_plan_keeps_the_bias_of_the_full_filter():
    """Its smaller filters differ in size alone: a plane stays lit, and the error is kept."""
    shadow_map, seen, _, inside = on_a_plane(LIGHTS["low sun"], 0.8, np.float64)
    shadow_map[20:28, 20:28] *= 0.5
    full = np.asarray(shadow.pcf(shadow_map, seen, size=9))
    assert full[inside].min() < 1
    for max_error in (0.0, 0.03, 0.5):
        plan = budget.shadow(shadow_map, seen, size=9, max_error=max_error)
        visible = np.asarray(plan(shadow_map, seen))
        assert np.sqrt(np.mean((visible - full) ** 2)) <= max_error + 1e-9
        assert (visible[(full == 1) & inside] == 1).all()
