"""Edits against the image rendered afresh, over long chains, bad lights and derivatives."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import relight as relight_scenes
from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    PinholeCamera,
    PointLight,
    SpotLight,
    relight,
    scene,
)


SIZE = (7, 9)
CAMERA = PinholeCamera.from_fov(0.9, height=SIZE[0], width=SIZE[1])


def point(rng):
    return PointLight(rng.uniform(-1, 1, 3), rng.uniform(0.5, 2, 3))


def spot(rng):
    return SpotLight(rng.uniform(-1, 1, 3), [0.1, 0.1, 1], rng.uniform(0.5, 2, 3), 0.3, 0.9)


def sun(rng):
    return DirectionalLight(rng.uniform((-1, -1, 1), (1, 1, 2)), rng.uniform(0.1, 0.5, 3))


def ambient(rng):
    return AmbientLight(rng.uniform(0.1, 0.3, 3))


KINDS = (point, spot, sun, ambient)


def make_gbuffer(dtype=np.float64):
    rng = np.random.default_rng(0)
    normal = rng.normal((0, 0, -1), 0.4, (*SIZE, 3))
    shader = rng.permutation(SIZE[0] * SIZE[1]).reshape(SIZE) % 4 - 1
    images = ("color", "ambient", "diffuse", "specular")
    floats = {name: rng.uniform(0.1, 1, (*SIZE, 3)) for name in images} | {
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "depth": np.where(shader == -1, np.inf, rng.uniform(1.5, 4, SIZE)),
        "roughness": rng.uniform(0.3, 0.9, SIZE),
    }
    return GBuffer(shader=shader, **{k: v.astype(dtype) for k, v in floats.items()})


GBUFFER = make_gbuffer()
SINGLE = make_gbuffer(np.float32)


def make_lights(count, seed=1, kinds=KINDS):
    rng = np.random.default_rng(seed)
    return [kinds[i % len(kinds)](rng) for i in range(count)]


def fresh(state, gbuffer=GBUFFER):
    return relight.render(gbuffer, CAMERA, state.lights)


def assert_close(image, expected, tolerance=1e-12):
    """Within a tolerance of the image's range."""
    limit = tolerance * float(jnp.max(expected))
    np.testing.assert_allclose(image, expected, rtol=0, atol=limit)


@pytest.mark.full
def test_every_method_gives_the_picture_of_its_lights():
    lights = make_lights(6)
    state = relight.start(GBUFFER, CAMERA, lights)
    assert_close(state.image, fresh(state))
    more = make_lights(5, seed=2)
    # The last of these is of another kind than the light whose place it takes.
    for i, light in ((0, more[0]), (5, more[1]), (3, more[3]), (2, more[0])):
        state = state.edit(i, light)
        assert state.lights[i] == light and len(state.lights) == 6
        assert_close(state.image, fresh(state))
    state = state.add(more[2])
    assert state.lights[6] == more[2]
    assert_close(state.image, fresh(state))
    state = state.remove(1)
    assert state.lights[1] == more[0] and len(state.lights) == 6
    assert_close(state.image, fresh(state))


def test_no_lights_are_black_and_lights_can_come_and_go():
    state = relight.start(GBUFFER, CAMERA, [])
    assert not state.image.any()
    for light in make_lights(4):
        state = state.add(light)
    for _ in range(4):
        state = state.remove(0)
    assert not state.image.any()


@pytest.mark.full
def test_visibility_goes_with_its_light():
    """Against the sum of `shade`, for lights with shadows and without, of every kind."""
    rng = np.random.default_rng(3)
    shadow = lambda: jnp.asarray(rng.uniform(0, 1, SIZE))
    lights, shadows = make_lights(5), [shadow(), None, shadow(), shadow(), None]

    def expected(state):
        pairs = zip(state.lights, state.visibilities, strict=True)
        return sum(relight.shade(GBUFFER, CAMERA, *pair) for pair in pairs)

    state = relight.start(GBUFFER, CAMERA, lights, visibilities=shadows)
    assert_close(state.image, expected(state))
    dim = shadow()
    for i, given in ((0, None), (1, dim), (2, dim), (3, dim)):
        state = state.edit(i, state.lights[i], given)
        assert_close(state.image, expected(state))
    state = state.add(lights[0], dim).remove(1)
    assert_close(state.image, expected(state))


@pytest.mark.full
def test_an_edit_keeps_the_shadow_unless_told_otherwise():
    rng = np.random.default_rng(5)
    lights, new = make_lights(4), make_lights(4, seed=8)
    shadows = [jnp.asarray(rng.uniform(0, 1, SIZE)) for _ in lights]
    state = relight.start(GBUFFER, CAMERA, lights, visibilities=shadows)
    for i, light in enumerate(new):
        shaded = lambda visible, i=i, light=light: relight.render(
            GBUFFER,
            CAMERA,
            [*lights[:i], light, *lights[i + 1 :]],
            visibilities=[*shadows[:i], visible, *shadows[i + 1 :]],
        )
        for edit in (
            state.edit(i, light),
            jax.jit(lambda s, n, i=i: s.edit(i, n))(state, light),
        ):
            assert_close(edit.image, shaded(shadows[i]))
            np.testing.assert_array_equal(edit.visibilities[i], shadows[i])
        without = state.edit(i, light, None)
        assert without.visibilities[i] is None
        assert_close(without.image, shaded(None))


@pytest.mark.full
def test_float32_stays_float32():
    state = relight.start(SINGLE, CAMERA, make_lights(4)).edit(1, make_lights(1)[0])
    assert state.image.dtype == jnp.float32
    half = eqx.tree_at(lambda g: g.color, SINGLE, SINGLE.color.astype(jnp.float16))
    assert relight.start(half, CAMERA, make_lights(1)).image.dtype == jnp.float16


def drift(state, gbuffer=SINGLE):
    expected = fresh(state, gbuffer)
    return float(jnp.max(jnp.abs(state.image - expected)) / jnp.max(expected))


@pytest.mark.full
def test_a_chain_of_edits_of_several_kinds_does_not_drift():
    """2000 edits in float32, of lights over four orders of magnitude: 2e-7 of the range."""
    rng = np.random.default_rng(4)
    pool = [
        eqx.tree_at(lambda light: light.color, light, light.color * 10 ** rng.uniform(-2, 2))
        for light in make_lights(24, seed=5, kinds=(point, ambient, spot))
    ]
    state = relight.start(SINGLE, CAMERA, pool[:8])
    for _ in range(2000):
        state = state.edit(int(rng.integers(8)), pool[rng.integers(24)])
    assert drift(state) < 1e-6


@pytest.mark.full
def test_ten_thousand_edits_in_a_loop_do_not_drift():
    """The worst chain: the same two lights in turn, so that what is lost is lost each time."""
    one, two, three = make_lights(3, kinds=(point,))

    @jax.jit
    def chain(state):
        def step(state, _):
            for i in (0, 1):
                for light in (two, one, three):
                    state = state.edit(i, light)
            return state, None

        return jax.lax.scan(step, state, None, length=10_000 // 6)[0]

    state = relight.start(SINGLE, CAMERA, [three, three, two])
    assert drift(chain(state)) < 1e-6


def test_a_bright_light_leaves_no_trace():
    lights = make_lights(3, kinds=(point,))
    state = relight.start(SINGLE, CAMERA, lights)
    glaring = PointLight([0, 0, 0], [1e8, 1e8, 1e8])
    after = state.edit(1, glaring).edit(0, lights[2]).edit(1, lights[1]).edit(0, lights[0])
    assert_close(after.image, state.image, 1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_light_that_is_not_finite_leaves_no_trace(bad):
    """Not even when others were edited in between; meanwhile it shows where it reaches."""
    lights = make_lights(3, kinds=(point,))
    state = relight.start(SINGLE, CAMERA, lights)
    # Made traced, where its numbers can't be looked at.
    glaring = jax.jit(lambda color: PointLight(jnp.zeros(3), color))(jnp.array([bad, 1, 1]))
    spoiled = state.edit(1, glaring)
    assert not np.isfinite(spoiled.image).all()
    assert not np.isnan(np.asarray(spoiled.image)[np.asarray(SINGLE.shader) < 0]).any()
    after = spoiled.edit(0, lights[2]).edit(1, lights[1]).edit(0, lights[0])
    assert_close(after.image, state.image, 1e-6)


def test_a_bad_pixel_stays_where_it_is():
    normal = GBUFFER.normal.at[2, 3].set(jnp.nan)
    shader = GBUFFER.shader.at[2, 3].set(2)
    bad = eqx.tree_at(lambda g: (g.normal, g.shader), GBUFFER, (normal, shader))
    state = relight.start(bad, CAMERA, make_lights(4)).edit(0, make_lights(1, seed=9)[0])
    wrong = np.isnan(np.asarray(state.image)).any(axis=-1)
    assert wrong[2, 3] and wrong.sum() == 1


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("count", [10, 100, 1000])
@pytest.mark.full
def test_the_work_of_an_edit_does_not_depend_on_the_number_of_lights(count):
    """Counted in what is compiled; `benchmarks` has the times."""

    def work(count):
        lights = make_lights(1, kinds=(point,)) * count
        state = eqx.tree_at(
            lambda s: (s.lights, s.visibilities),
            relight.start(GBUFFER, CAMERA, lights[:1]),
            (tuple(lights), (None,) * count),
        )
        edit = jax.jit(lambda state, light: state.edit(0, light).image)
        cost = edit.lower(state, lights[0]).compile().cost_analysis()
        return cost["flops"], cost["bytes accessed"]

    np.testing.assert_allclose(work(count), work(1), rtol=0.01)


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
@pytest.mark.full
def test_derivatives_in_the_edited_light_are_those_of_shading_it(make):
    """Forward and reverse; `shade`'s own are compared with differences in its tests."""
    light, old = make_lights(2, kinds=(make,))
    shadow = jnp.asarray(np.random.default_rng(6).uniform(0, 1, SIZE))
    along = jax.tree.map(jnp.cos, (light, shadow))
    state = relight.start(GBUFFER, CAMERA, [old, *make_lights(3)])
    edited = lambda light, shadow: state.edit(0, light, shadow).image
    shaded = lambda light, shadow: relight.shade(GBUFFER, CAMERA, light, shadow)

    @jax.jit
    def derivatives(light, shadow):
        pushed, expected = (
            jax.jvp(image, (light, shadow), along)[1] for image in (edited, shaded)
        )
        weight = jnp.sin(expected * 100)
        pulled, wanted = (
            jax.vjp(image, light, shadow)[1](weight) for image in (edited, shaded)
        )
        return (pushed, pulled), (expected, wanted)

    found, expected = derivatives(light, shadow)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.full
def test_derivatives_in_the_cache_are_those_of_render():
    lights = make_lights(4)
    state = relight.start(GBUFFER, CAMERA, [*lights[:3], lights[0]])
    floats, others = eqx.partition(GBUFFER, eqx.is_inexact_array)
    floats = eqx.tree_at(
        lambda g: g.depth, floats, jnp.where(floats.depth < 9, floats.depth, 9)
    )

    def edited(floats):
        gbuffer = eqx.combine(floats, others)
        state = relight.start(gbuffer, CAMERA, [*lights[:3], lights[0]])
        return jnp.sum(jnp.sin(state.edit(3, lights[3]).image))

    def rendered(floats):
        return jnp.sum(jnp.sin(relight.render(eqx.combine(floats, others), CAMERA, lights)))

    one, other = (jax.jit(jax.grad(image))(floats) for image in (edited, rendered))
    for name in ("ambient", "diffuse", "specular", "normal", "depth", "roughness"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=1e-8, atol=1e-10
        )
    assert state.image.shape == (*SIZE, 3)


@jax.jit
def both_modes(floats, others, light):
    def loss(floats, light):
        state = relight.start(eqx.combine(floats, others), CAMERA, [light])
        return jnp.sum(state.edit(0, light).image ** 2)

    along = jax.tree.map(jnp.ones_like, (floats, light))
    return jax.jvp(loss, (floats, light), along)[1], jax.grad(loss, (0, 1))(floats, light)


@pytest.mark.parametrize(
    "light",
    [
        PointLight([0, 0, 2.0], [1, 1, 1]),  # at the surface of the pixel on the axis
        DirectionalLight([1, 0, 0], [1, 1, 1]),  # N.L = 0 there
        DirectionalLight([0, 0, -1], [1, 1, 1]),  # from behind
        SpotLight([0, 0, 1.0], [0, 0, 1], [1, 1, 1], 0.0, 0.1),  # along its axis
    ],
    ids=["at-surface", "grazing", "behind", "on-axis"],
)
@pytest.mark.full
def test_derivatives_at_degenerate_points_are_finite(light):
    """Smooth and rough surfaces of every model, the middle one on the camera's axis."""
    images = ("color", "ambient", "diffuse", "specular")
    for shift in range(6):
        model = (np.arange(63).reshape(SIZE) + shift) % 6
        gbuffer = GBuffer(
            **{name: jnp.full((*SIZE, 3), 0.5) for name in images},
            shader=model % 3,
            normal=jnp.broadcast_to(jnp.array([0.0, 0, -1]), (*SIZE, 3)),
            depth=jnp.full(SIZE, 2.0),
            roughness=jnp.where(model < 3, 0.0, 1.0),
        )
        floats, others = eqx.partition(gbuffer, eqx.is_inexact_array)
        for leaf in jax.tree.leaves(both_modes(floats, others, light)):
            assert np.isfinite(leaf).all()


def test_vmap_over_edits():
    state = relight.start(GBUFFER, CAMERA, make_lights(3, kinds=(point,)))
    lights = make_lights(2, seed=7, kinds=(point,))
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lights)
    images = jax.vmap(lambda light: state.edit(1, light).image)(batch)
    for image, light in zip(images, lights, strict=True):
        assert_close(image, state.edit(1, light).image)


MASK = np.random.default_rng(8).random(SIZE) < 0.4
NEW = np.array([0.9, 0.2, 0.4])


def painted(gbuffer, **images):
    """A cache with other values in the mask, pixel by pixel in NumPy."""
    fields = {name: np.array(value) for name, value in vars(gbuffer).items()}
    for name, value in images.items():
        fields[name][MASK] = value
    return GBuffer(**fields)


@pytest.mark.parametrize("name", ["diffuse", "specular", "roughness"])
@pytest.mark.full
def test_paint_gives_the_picture_of_the_new_material(name):
    value = {"roughness": 0.55}.get(name, NEW)
    state = relight.start(GBUFFER, CAMERA, make_lights(5)).paint(MASK, **{name: value})
    assert_close(state.image, fresh(state, painted(GBUFFER, **{name: value})))
    # Lights can be edited as before.
    state = state.edit(0, make_lights(1, seed=11)[0])
    assert_close(state.image, fresh(state, painted(GBUFFER, **{name: value})))


def test_painting_the_colour_takes_ambient_and_diffuse_along():
    black = eqx.tree_at(lambda g: g.color, GBUFFER, GBUFFER.color.at[:, :4, 1].set(0))
    state = relight.start(black, CAMERA, make_lights(5)).paint(MASK, color=NEW)
    color = np.asarray(black.color)
    ratio = NEW / np.where(color == 0, 1, color)
    expected = {
        name: np.where(color == 0, NEW, np.asarray(getattr(black, name)) * ratio)[MASK]
        for name in ("ambient", "diffuse")
    }
    assert_close(state.image, fresh(state, painted(black, **expected)))


def test_painting_reflectances_shades_no_light():
    state = relight.start(GBUFFER, CAMERA, make_lights(5))
    reflectances = dict.fromkeys(("color", "diffuse", "specular"), NEW)
    shades = lambda **new: "scan" in str(jax.make_jaxpr(lambda s: s.paint(MASK, **new))(state))
    assert not shades(**reflectances)
    assert shades(roughness=0.5)


@pytest.mark.full
def test_derivatives_of_paint():
    state = relight.start(GBUFFER, CAMERA, make_lights(3))
    new = {"color": NEW, "diffuse": NEW[::-1], "specular": NEW, "roughness": np.array(0.6)}
    loss = lambda new: jnp.sum(jnp.sin(state.paint(MASK, **new).image))
    along = {name: np.cos(value) for name, value in new.items()}

    @jax.jit
    def derivatives(new):
        value, pushed = jax.jvp(loss, (new,), (along,))
        return value, pushed, jax.grad(loss)(new)

    moved = lambda step: derivatives({k: jnp.asarray(new[k] + step * along[k]) for k in new})[0]
    _, pushed, gradient = derivatives(jax.tree.map(jnp.asarray, new))
    assert float(pushed) == pytest.approx(float(moved(1e-6) - moved(-1e-6)) / 2e-6, rel=1e-6)
    total = sum(np.vdot(gradient[name], along[name]) for name in new)
    assert float(pushed) == pytest.approx(total, rel=1e-9)


def test_errors_name_the_argument():
    start = inspect.unwrap(relight.start)
    light, images = make_lights(1)[0], [np.ones(SIZE)]
    with pytest.raises(ValueError, match=r"`start\(lights\)` must be a sequence"):
        start(GBUFFER, CAMERA, light)
    with pytest.raises(ValueError, match=r"`start\(lights\[1\]\)` must be one of Ambient"):
        start(GBUFFER, CAMERA, [light, 3])
    with pytest.raises(ValueError, match=r"`start\(visibilities=...\)` must hold an image or"):
        start(GBUFFER, CAMERA, [light, light], visibilities=images)
    state = start(GBUFFER, CAMERA, [light])
    edit, add, remove, paint = (
        inspect.unwrap(getattr(relight.RelightState, name))
        for name in ("edit", "add", "remove", "paint")
    )
    for i in (1, -1):
        with pytest.raises(ValueError, match=rf"`edit\(i\)` must be in \[0, 1\), got {i}"):
            edit(state, i, light)
    with pytest.raises(ValueError, match=r"`remove\(i\)` must be in \[0, 1\), got 7"):
        remove(state, 7)
    with pytest.raises(ValueError, match=r"`edit\(i\)` must be a static integer"):
        jax.jit(lambda i: edit(state, i, light))(0)
    with pytest.raises(ValueError, match=r"`add\(light\)` must be one of Ambient.*got int"):
        add(state, 3)
    with pytest.raises(ValueError, match=r"`edit\(visibility\)` must have shape \(7, 9\)"):
        edit(state, 0, light, np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"`edit\(visibility\)` must be an image, None or"):
        edit(state, 0, light, "none")
    with pytest.raises(ValueError, match=r"`paint\(mask\)` must have the cache's height"):
        paint(state, np.ones((2, 2), bool), color=NEW)
    with pytest.raises(ValueError, match=r"`paint\(color=...\)` must have shape \(3,\)"):
        paint(state, MASK, color=0.5)


@pytest.mark.full
def test_what_is_rendered_anew_is_what_is_edited():
    """The two images that the benchmark times are the same, shadows and all."""
    mesh, camera = relight_scenes.view((24, 32))
    lights = relight_scenes.lights(2)
    image = relight_scenes.rendered_anew(mesh, camera, lights, (24, 32))
    gbuffer = scene.gbuffer(mesh, camera, height=24, width=32, backend="embree")
    starts = relight_scenes.shadow_starts(mesh, gbuffer, camera)
    visible = [
        jnp.asarray(relight_scenes.unshadowed(mesh, starts, light).reshape(24, 32), jnp.float32)
        for light in lights
    ]
    assert 0.05 < float(jnp.mean(jnp.stack(visible))) < 0.99
    state = relight.start(gbuffer, camera, lights, visibilities=[None, visible[1]])
    state = state.edit(0, lights[0], visible[0])
    np.testing.assert_allclose(state.image, image, rtol=1e-4, atol=1e-5)
