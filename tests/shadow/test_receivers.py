"""Visible points in a light's space."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera, shadow
from jaxfx._sampling import pixel_centers
from tests.helpers.forms import first


HEIGHT, WIDTH = 6, 7


def eye_camera():
    return PinholeCamera.look_at(
        [0, -3, 0], [0.1, 1, 2], up=[0, -1, 0], fov_y=0.8, height=HEIGHT, width=WIDTH
    )


def sun_camera():
    pose = PinholeCamera.look_at(
        [1, -5, 0], [0, 0, 3], up=[0, 0, 1], fov_y=1.0, height=8, width=8
    ).world_from_camera
    return OrthographicCamera(10.0, [32, 32], pose)


def spot_camera():
    return PinholeCamera.look_at(
        [1, -5, 0], [0, 0, 3], up=[0, 0, 1], fov_y=1.0, height=64, width=64
    )


def on_plane(camera, normal, point):
    """The depth at which each pixel's ray meets a plane."""
    centers = pixel_centers(HEIGHT, WIDTH)
    ones = jnp.ones((HEIGHT, WIDTH))
    start = np.asarray(camera.unproject(centers, 0 * ones))
    ray = np.asarray(camera.unproject(centers, ones)) - start
    return ((point - start) @ normal) / (ray @ normal)


@first("light", [sun_camera(), spot_camera()])
def test_receivers_are_the_points_in_the_lights_space(light):
    camera = eye_camera()
    depth = np.random.default_rng(0).uniform(2, 5, (HEIGHT, WIDTH))
    found = shadow.receivers(depth, camera, light)
    for j, i in np.ndindex(HEIGHT, WIDTH):
        point = camera.unproject(jnp.array([i + 0.5, j + 0.5]), jnp.asarray(depth[j, i]))
        pixel, z = light.project(point)
        np.testing.assert_allclose([found.u[j, i], found.v[j, i]], pixel, rtol=1e-12)
        np.testing.assert_allclose(found.z[j, i], z, rtol=1e-12)


@pytest.mark.parametrize("light", [sun_camera(), spot_camera()])
def test_a_sequence_of_one_camera_is_that_camera(light):
    data = np.full((HEIGHT, WIDTH), 3.0), eye_camera()
    one, same = (shadow.receivers(*data, each) for each in (light, (light,)))
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))


@first("light", [sun_camera(), spot_camera()])
@first("is_given", [False, True])
def test_the_slope_is_the_change_of_depth_from_texel_to_texel(light, is_given):
    camera, normal = eye_camera(), np.array([0.2, -1.0, 0.1])
    depth = on_plane(camera, normal, np.array([0.0, 1.0, 0.0]))
    normals = np.broadcast_to(normal, (HEIGHT, WIDTH, 3)) if is_given else None
    found = shadow.receivers(depth, camera, light, normal=normals)

    def plane_z(u, v):
        """The depth from the light at which its pixel (u, v) meets the plane."""
        start = np.asarray(light.unproject(jnp.array([u, v]), jnp.zeros(())))
        ray = np.asarray(light.unproject(jnp.array([u, v]), jnp.ones(()))) - start
        return (normal @ (np.array([0.0, 1.0, 0.0]) - start)) / (normal @ ray)

    for j, i in np.ndindex(HEIGHT, WIDTH):
        u, v = float(found.u[j, i]), float(found.v[j, i])
        du = (plane_z(u + 1e-4, v) - plane_z(u - 1e-4, v)) / 2e-4
        dv = (plane_z(u, v + 1e-4) - plane_z(u, v - 1e-4)) / 2e-4
        assert float(found.slope[j, i]) == pytest.approx(abs(du) + abs(dv), rel=1e-6)


def test_a_grazed_surface_has_a_bounded_slope():
    """Light along the surface: the slope is that of a hundredth."""
    light = OrthographicCamera(2.0, [4, 4], np.eye(4))
    normals = np.broadcast_to([1.0, 0.0, 0.0], (HEIGHT, WIDTH, 3))
    found = shadow.receivers(np.ones((HEIGHT, WIDTH)), eye_camera(), light, normal=normals)
    np.testing.assert_allclose(np.asarray(found.slope)[found.z > 0], 100 / 2)


def test_normals_point_at_the_camera_and_offset_towards_them():
    camera, light = eye_camera(), sun_camera()
    normal = np.array([0.0, -1.0, 0.0])
    depth = on_plane(camera, normal, np.array([0.0, 1.0, 0.0]))
    moved = shadow.receivers(depth, camera, light, normal_offset=0.3)
    centers = pixel_centers(HEIGHT, WIDTH)
    pixels, z = light.project(
        camera.unproject(centers, jnp.asarray(depth)) + 0.3 * jnp.asarray(normal)[None, None]
    )
    np.testing.assert_allclose(np.stack([moved.u, moved.v], axis=-1), pixels, rtol=1e-9)
    np.testing.assert_allclose(moved.z, z, rtol=1e-9)


def test_a_silhouette_takes_its_normal_from_its_own_side():
    camera = PinholeCamera.from_fov(0.8, height=5, width=8)
    light = OrthographicCamera(5.0, [4, 4], np.eye(4))
    depth = np.full((5, 8), 2.0)
    depth[:, 4:] = 7.0
    np.testing.assert_allclose(shadow.receivers(depth, camera, light).slope, 0, atol=1e-12)


@pytest.mark.parametrize("bad", [np.inf, np.nan, -1.0, 0.0])
def test_a_pixel_that_shows_nothing_is_outside_of_every_map(bad):
    camera, light = eye_camera(), spot_camera()
    depth = np.random.default_rng(0).uniform(2, 5, (HEIGHT, WIDTH))
    clean = shadow.receivers(depth, camera, light)
    broken = depth.copy()
    broken[2, 3] = bad
    found = shadow.receivers(broken, camera, light)
    assert all(field[2, 3] == -1 for field in (found.u, found.v, found.z))
    assert np.isfinite(found.slope).all()
    for field, same in zip(found[:3], clean[:3], strict=True):
        changed = np.array(field != same)
        changed[2, 3] = False
        assert not changed.any()


@pytest.mark.full
def test_points_beside_and_behind_the_light_have_finite_gradients():
    """The middle row lies in the light's own plane, where a projection divides by 0."""
    camera = OrthographicCamera(1.0, [2.5, 2.5], np.eye(4))
    pose = np.eye(4)[[0, 2, 1, 3]] * np.array([1, -1, 1, 1])[:, None]  # looks along -y
    light = PinholeCamera.from_fov(1.0, height=4, width=4, world_from_camera=pose)
    depth = jnp.full((5, 5), 2.0)

    def loss(depth, light):
        found = shadow.receivers(depth, camera, light)
        return sum(jnp.sum(field) for field in found)

    found = shadow.receivers(depth, camera, light)
    np.testing.assert_array_equal(found.z[2:], -1)
    assert (np.asarray(found.z[:2]) > 0).all()
    for leaf in jax.tree.leaves(jax.jit(jax.grad(loss, argnums=(0, 1)))(depth, light)):
        assert np.isfinite(leaf).all()


SOFT = {
    "pcf": lambda texels, seen, light, **given: shadow.pcf(texels, seen, softness=0.5, **given),
    "edge_pcf": lambda texels, seen, light, **given: shadow.edge_pcf(
        texels, seen, softness=0.5, edges="depth", **given
    ),
    "pcss": lambda texels, seen, light, **given: shadow.pcss(
        texels, seen, light, softness=0.5, light_size=0.3, **given
    ),
    "variance": lambda texels, seen, light, **given: shadow.variance(texels, seen, **given),
}


@pytest.mark.parametrize("form", SOFT.values(), ids=SOFT)
@pytest.mark.full
def test_derivatives_reach_depth_and_light_through_every_soft_form(form):
    """Forward, as the shorter program; that reverse agrees is shown part by part elsewhere."""
    rng = np.random.default_rng(4)
    shadow_map = rng.uniform(3, 8, (64, 64))

    def total(depth, light):
        seen = shadow.receivers(depth, eye_camera(), light)
        return jnp.sum(form(shadow_map, seen, light, size=3, bias=0.1, slope_bias=0.1) ** 2)

    at = jnp.asarray(rng.uniform(2, 4, (HEIGHT, WIDTH))), spot_camera()
    program = jax.jit(lambda at, along: jax.jvp(total, at, along))
    zeros = jax.tree.map(jnp.zeros_like, at)
    for index, value in enumerate(at):
        some = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), value)
        along = (*zeros[:index], some, *zeros[index + 1 :])
        moved = [jax.tree.map(lambda x, d, s=s: x + s * d, at, along) for s in (1e-6, -1e-6)]
        ahead, behind = (float(program(each, along)[0]) for each in moved)
        expected = (ahead - behind) / 2e-6
        assert abs(expected) > 1e-3
        assert float(program(at, along)[1]) == pytest.approx(expected, rel=1e-4)


def test_errors_name_their_argument():
    function = inspect.unwrap(shadow.receivers)
    camera, depth = eye_camera(), np.ones((HEIGHT, WIDTH))
    errors = [
        ("depth", (np.ones(3), camera, camera), {}),
        ("light_camera", (depth, camera, ()), {}),
        ("light_camera", (depth, camera, (camera, sun_camera())), {}),
        ("normal=...", (depth, camera, camera), {"normal": depth}),
        ("normal_offset=...", (depth, camera, camera), {"normal_offset": depth}),
    ]
    for name, data, options in errors:
        with pytest.raises(ValueError) as caught:
            function(*data, **options)
        assert str(caught.value).startswith(f"`receivers({name})`")
