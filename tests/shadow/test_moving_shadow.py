"""The shadow that moves with its light, over a plane, where all of it is known."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SpotLight,
    shadow as shadows,
)
from tests.helpers.forms import first


SIZE, SCALE = 48, 12.0
PLANE, PLATE, HALF = 4.0, 2.5, 0.5

STRAIGHT = OrthographicCamera(SCALE, jnp.array([SIZE / 2, SIZE / 2]), jnp.eye(4))
# Looks at the same 4 x 4 of the plane from the origin.
CENTRAL = PinholeCamera(
    jnp.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]]), jnp.eye(4)
)


def plane(slope=0.0):
    """What `STRAIGHT` sees of the plane z = 4 + slope * x, which faces it."""
    x = (np.arange(SIZE) + 0.5 - SIZE / 2) / SCALE
    depth = np.broadcast_to(PLANE + slope * x, (SIZE, SIZE))
    normal = np.array([slope, 0, -1]) / np.hypot(slope, 1)
    image, flat = np.ones((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE))
    normals = np.broadcast_to(normal, image.shape)
    return GBuffer(image, flat.astype(int), image, image, image, normals, depth, flat)


def shadow_map(camera, gbuffer):
    """Depths of the plane, and of a square plate of side 1 over it."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    unit = SCALE if isinstance(camera, OrthographicCamera) else SIZE / PLATE
    over = (np.abs(x) < HALF * unit) & (np.abs(y) < HALF * unit)
    return np.where(over, PLATE, np.asarray(gbuffer.depth))


def shadow(light_camera=STRAIGHT, gbuffer=None, size=9, with_plate=True):
    gbuffer = plane() if gbuffer is None else gbuffer
    depths = shadow_map(light_camera, gbuffer) if with_plate else gbuffer.depth
    return shadows.MovingShadow(
        depths, light_camera, gbuffer, STRAIGHT, softness=0.3, size=size
    )


def sun(x=0.0, y=0.0):
    return DirectionalLight([x, y, 1.0], jnp.ones(3))


def middle(visibility):
    """Centre and area of what is dark, in scene units."""
    dark = 1 - np.asarray(visibility)
    along = (np.arange(SIZE) + 0.5 - SIZE / 2) / SCALE
    centre = [(dark.sum(axis) * along).sum() / dark.sum() for axis in (0, 1)]
    return np.array(centre), dark.sum() / SCALE**2


def spline(x):
    """The cubic B-spline in its usual two pieces."""
    x = np.abs(x)
    return np.where(x < 1, 2 / 3 - x**2 + x**3 / 2, np.where(x < 2, (2 - x) ** 3 / 6, 0))


@pytest.mark.parametrize("size", [3, 9])
def test_in_its_own_light_it_is_the_filtered_shadow(size):
    x = np.arange(SIZE)
    kernel = spline((x[:, None] - x) * 4 / size) * 4 / size
    over = np.abs(x + 0.5 - SIZE / 2) < HALF * SCALE
    covered = np.clip(np.outer(kernel @ over, kernel @ over), 0, 1)
    expected = 1 - covered**2 * (3 - 2 * covered)
    np.testing.assert_allclose(shadow(size=size)(sun()), expected, atol=1e-12)


@pytest.mark.parametrize("slope", [0.0, 1.0, -3.0])
def test_a_plane_does_not_shadow_itself(slope):
    visibility = shadow(gbuffer=plane(slope), with_plate=False)(sun(0.1, -0.2))
    np.testing.assert_array_equal(visibility, 1)


@pytest.mark.parametrize("step", [(0.05, 0.0), (0.0, -0.05), (0.04, 0.03)])
def test_it_moves_by_the_height_of_the_occluder(step):
    soft = shadow()
    home, area = middle(soft(sun()))
    moved, same_area = middle(soft(sun(*step)))
    np.testing.assert_allclose(moved - home, (PLANE - PLATE) * np.array(step), atol=5e-4)
    np.testing.assert_allclose(same_area, area, rtol=5e-3)


def test_a_step_as_large_as_the_kernel_falls_short():
    """By less than a fifth: occluders past the kernel's edge are not seen to come."""
    soft = shadow()
    step = 4.5 / SCALE / (PLANE - PLATE)
    moved = (middle(soft(sun(step)))[0] - middle(soft(sun()))[0])[0] / (4.5 / SCALE)
    assert 0.7 < moved < 0.95


@pytest.mark.parametrize("kind", [PointLight, SpotLight], ids=lambda kind: kind.__name__)
def test_it_moves_against_a_light_nearby(kind):
    rest = ([0.0, 0.0, 1.0], jnp.ones(3), 1.0, 1.5) if kind is SpotLight else (jnp.ones(3),)
    soft = shadow(CENTRAL)
    home, area = middle(soft(kind([0.0, 0.0, 0.0], *rest)))
    # The plate's 20 of 48 texels, on 4 units of the plane.
    assert area == pytest.approx((20 / 48 * 4) ** 2, rel=0.02)
    moved, _ = middle(soft(kind([0.1, -0.05, 0.0], *rest)))
    ratio = (PLANE - PLATE) / PLATE
    np.testing.assert_allclose(moved - home, [-0.1 * ratio, 0.05 * ratio], atol=2e-3)


@first(
    ("camera", "make", "start"),
    [
        (STRAIGHT, lambda v: DirectionalLight(v, jnp.ones(3)), [0.05, -0.1, 1.0]),
        (CENTRAL, lambda v: PointLight(v, jnp.ones(3)), [0.05, -0.1, 0.1]),
    ],
    ids=["directional", "point"],
)
def test_derivatives_against_differences(camera, make, start):
    soft = shadow(camera)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(SIZE, SIZE)))
    f = jax.jit(lambda v: jnp.sum(weight * soft(make(v))))
    v = jnp.array(start)
    reverse = jax.grad(f)(v)
    for axis, derivative in zip(jnp.eye(3), reverse, strict=True):
        forward = jax.jvp(f, (v,), (axis,))[1]
        np.testing.assert_allclose(forward, derivative, rtol=1e-9, atol=1e-9)
    quotients = [(f(v + 1e-6 * e) - f(v - 1e-6 * e)) / 2e-6 for e in jnp.eye(3)]
    np.testing.assert_allclose(reverse, jnp.stack(quotients), rtol=1e-5, atol=1e-6)
    assert np.abs(reverse).max() > 1


@first("missing", [0.0, -1.0, np.nan])
@pytest.mark.full
def test_what_is_missing_shadows_nothing_and_spoils_no_derivative(missing):
    """In the map it is as nothing there; in the cache, whose normals then are no numbers."""
    gbuffer = plane()
    full, weight = (
        shadow_map(STRAIGHT, gbuffer),
        np.random.default_rng(0).normal(size=(SIZE,) * 2),
    )
    lost = np.zeros((SIZE, SIZE), bool)
    lost[20:23, 20:28] = True
    images = [gbuffer.color, gbuffer.shader, *[gbuffer.color] * 3]
    found = []
    for empty, unread in ((np.inf, gbuffer.normal), (missing, np.nan)):
        normal = jnp.where(lost[..., None], unread, gbuffer.normal)
        depth = jnp.where(lost, empty, gbuffer.depth)
        holed = GBuffer(*images, normal, depth, gbuffer.roughness)
        soft = shadows.MovingShadow(
            jnp.where(lost, empty, full), STRAIGHT, holed, STRAIGHT, softness=0.3
        )
        loss = lambda v, soft=soft: jnp.sum(weight * soft(DirectionalLight(v, jnp.ones(3))))
        at = jnp.array([0.05, -0.1, 1.0])
        forward = [jax.jvp(loss, (at,), (axis,))[1] for axis in jnp.eye(3)]
        found.append((soft(sun()), jax.grad(loss)(at), jnp.stack(forward)))
    for one, other in zip(*found, strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_allclose(other, one, atol=1e-9)


def test_nothing_shown_and_nothing_known():
    gbuffer = plane()
    empty = np.full((SIZE, SIZE), np.inf)
    nothing = shadows.MovingShadow(empty, STRAIGHT, gbuffer, STRAIGHT, softness=0.3)
    np.testing.assert_array_equal(nothing(sun()), 1)
    images = (gbuffer.color, gbuffer.shader, *[gbuffer.color] * 3, gbuffer.normal)
    hole = GBuffer(*images, gbuffer.depth.at[24, 24].set(jnp.inf), gbuffer.roughness)
    holed = shadows.MovingShadow(
        shadow_map(STRAIGHT, gbuffer), STRAIGHT, hole, STRAIGHT, softness=0.3
    )
    expected = np.asarray(shadow()(sun())).copy()
    assert expected[24, 24] == 0
    expected[24, 24] = 1
    np.testing.assert_allclose(holed(sun()), expected, atol=1e-12)


FAULTS = {
    "MovingShadow(shadow_map)": {"shadow_map": np.zeros(3)},
    "MovingShadow(shadow_map) must hold real": {"shadow_map": np.zeros((3, 3), complex)},
    "MovingShadow(size=...)": {"size": 4},
    "MovingShadow(softness=...)": {"softness": 0.0},
}


@pytest.mark.parametrize(("message", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(message, fault):
    given = {"shadow_map": np.ones((3, 3)), "softness": 0.1} | fault
    call, _, rest = message.partition(" ")
    with pytest.raises(ValueError, match=re.escape(f"`{call}` {rest}")):
        inspect.unwrap(shadows.MovingShadow.__init__)(
            object.__new__(shadows.MovingShadow),
            light_camera=STRAIGHT,
            gbuffer=plane(),
            camera=STRAIGHT,
            **given,
        )


@pytest.mark.parametrize(
    ("camera", "light"),
    [(STRAIGHT, PointLight(jnp.zeros(3), jnp.ones(3))), (CENTRAL, sun())],
    ids=["point", "directional"],
)
def test_a_light_of_another_kind_is_refused(camera, light):
    with pytest.raises(ValueError, match=r"`MovingShadow\(light\)` must be directional"):
        shadow(camera)(light)


def test_an_ambient_light_has_no_shadow():
    with pytest.raises(ValueError, match=r"`MovingShadow\(light\)` must be .*got AmbientLight"):
        inspect.unwrap(shadows.MovingShadow.__call__)(
            shadow(CENTRAL), AmbientLight(jnp.ones(3))
        )
