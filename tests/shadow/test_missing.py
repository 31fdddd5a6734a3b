"""What is missing in a map or among receivers: it shadows nothing, and spoils no derivative."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.shadow import noise
from jaxfx import OrthographicCamera, PinholeCamera, shadow
from tests.helpers.forms import first


LIGHT = PinholeCamera.from_fov(0.8, height=24, width=24)
SOFT = {"size": 3, "softness": 0.3}
FILTERS = {
    "hard": shadow.hard,
    "prefiltered": lambda *data, **bias: shadow.prefiltered(*data, size=3, **bias),
    "pcf": lambda *data, **bias: shadow.pcf(*data, **SOFT, kernel="tent", **bias),
    "edge_pcf": lambda *data, **bias: shadow.edge_pcf(*data, **SOFT, edges="depth", **bias),
    "pcss": lambda *data, **bias: shadow.pcss(*data, LIGHT, light_size=0.4, **SOFT, **bias),
    "variance": lambda *data, **bias: shadow.variance(*data, size=3, **bias),
}


@first("name", FILTERS)
def test_a_missing_texel_is_as_one_where_nothing_is(name):
    shadow_map, receivers = noise()
    lost = np.random.default_rng(0).random(shadow_map.shape) < 0.2
    empty = np.where(lost, np.inf, shadow_map)
    expected = FILTERS[name](empty, receivers)
    kinds = np.random.default_rng(1).choice([0.0, -0.0, -2.0, -np.inf, np.nan], lost.shape)
    found = FILTERS[name](np.where(lost, kinds, shadow_map), receivers)
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found).all()


@first("name", FILTERS)
def test_no_derivative_is_lost_to_one_bad_texel_or_receiver(name):
    """In the map, the receivers and both biases: finite, and alike in both modes."""
    shadow_map, receivers = noise()
    fields = [np.array(field, float) for field in receivers]
    for index, (field, bad) in enumerate(
        (f, bad) for f in range(4) for bad in (np.nan, np.inf, -np.inf)
    ):
        fields[field][index % fields[0].shape[0], 2] = bad
    for row, bad in enumerate((0.0, -1.0, np.nan, np.inf, -np.inf)):
        shadow_map[row, row] = bad
    filtered = lambda shadow_map, receivers, bias, slope_bias: FILTERS[name](
        shadow_map, receivers, bias=bias, slope_bias=slope_bias
    )
    data = jax.tree.map(
        jnp.asarray, (shadow_map, shadow.Receivers(*fields), np.float64(0.05), np.float64(0.1))
    )
    check_both_modes(filtered, data)


def check_both_modes(function, arguments):
    rng = np.random.default_rng(0)
    like = lambda tree: jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), tree)

    @jax.jit
    def both(arguments, along, weight):
        value, pushed = jax.jvp(function, arguments, along)
        pulled = jax.vjp(function, *arguments)[1](weight)
        sides = jax.tree.leaves(pulled), jax.tree.leaves(along)
        product = sum(jnp.vdot(*pair) for pair in zip(*sides, strict=True))
        ahead = sum(map(jnp.vdot, jax.tree.leaves(weight), jax.tree.leaves(pushed)))
        return value, pushed, pulled, product - ahead

    along, weight = like(arguments), like(jax.eval_shape(function, *arguments))
    *results, apart = both(arguments, along, weight)
    for path, leaf in jax.tree_util.tree_leaves_with_path(results):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
    assert abs(float(apart)) < 1e-6


@pytest.mark.parametrize("kind", ["pinhole", "orthographic"])
@pytest.mark.full
def test_no_derivative_of_receivers_is_lost_to_a_hole(kind):
    """With normals that are no numbers there, which nobody reads."""
    camera = PinholeCamera.from_fov(0.7, height=6, width=8)
    pose = np.eye(4)
    pose[:3, 3] = [0.5, -0.3, 0.2]
    light = PinholeCamera.from_fov(0.9, height=9, width=9, world_from_camera=pose)
    if kind == "orthographic":
        light = OrthographicCamera(3.0, [4.0, 4.0], pose)
    rng = np.random.default_rng(0)
    depth, normal = rng.uniform(2, 3, (6, 8)), rng.normal(size=(6, 8, 3))
    holes = [0.0, -1.0, np.nan, np.inf, -np.inf]
    depth[range(5), range(5)], normal[range(5), range(5)] = holes, np.nan

    def seen(depth, normal, offset, camera, light):
        return shadow.receivers(depth, camera, light, normal=normal, normal_offset=offset)

    data = jnp.asarray(depth), jnp.asarray(normal), jnp.asarray(0.02), camera, light
    check_both_modes(seen, data)
    check_both_modes(shadow.receivers, (data[0], camera, light))


@pytest.mark.parametrize("scale", [1e-9, 1e-6, 1.0, 1e6, 1e15])
def test_a_slope_is_of_any_scale(scale):
    """A plane that light grazes, in float32: the slope per texel is that at scale 1."""
    rotation, pose = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]), np.eye(4)
    pose[:3, :3] = rotation
    depth = np.full((5, 7), 2 * scale, np.float32)
    camera = PinholeCamera(np.float32([[4000, 0, 3.5], [0, 4000, 2.5], [0, 0, 1]]), np.eye(4))
    light = OrthographicCamera(np.float32(10 / scale), np.float32([5, 5]), pose)
    cameras = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (camera, light))
    slope = shadow.receivers(depth, *cameras).slope
    np.testing.assert_allclose(slope / scale, 0.1 * 0.6 / 0.8, rtol=2e-3)


def test_a_slope_far_from_the_origin():
    """All moved together by a thousand scene sizes, in float32: as at the origin."""
    place = np.array([3000.0, -2000.0, 1000.0])
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    normal = np.broadcast_to([0, 0, -1], (5, 7, 3)).astype(np.float32)
    slopes = []
    for where in (np.zeros(3), place):
        eye = PinholeCamera.from_fov(0.8, height=5, width=7)
        light = OrthographicCamera(100.0, [5.0, 5.0], pose)
        moved = jax.tree.map(
            lambda leaf: leaf.astype(jnp.float32),
            [
                eqx.tree_at(
                    lambda c: c.world_from_camera, c, c.world_from_camera.at[:3, 3].add(where)
                )
                for c in (eye, light)
            ],
        )
        seen = shadow.receivers(np.full((5, 7), 2, np.float32), *moved, normal=normal)
        slopes.append(seen.slope)
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-5)


@pytest.mark.parametrize("sky", [1e7, 1e10, 1e20, 1e37])
@pytest.mark.full
def test_a_far_sky_in_a_map_of_moments_changes_nothing_away_from_it(sky):
    """A variance shadow map in float32, whose unit is that of all depths."""
    shadow_map = np.full((20, 20), 5, np.float32)
    shadow_map[6:11, 5:10] = 2
    x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(20) + 0.5)
    fields = (field.astype(np.float32) for field in (x, y, np.full_like(x, 5), 0 * x))
    receivers, visible = shadow.Receivers(*fields), []
    for far in (5, sky):
        shadow_map[0] = far
        found = shadow.variance(shadow_map, receivers, size=3, bias=0.01)
        visible.append(np.asarray(found)[3:])
    assert 0.2 < visible[0].std() < 0.5
    np.testing.assert_allclose(visible[1], visible[0], atol=1e-5)
