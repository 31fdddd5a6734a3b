"""A picture of all directions against sums over each of them, in NumPy."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    AmbientLight,
    EnvironmentLight,
    GBuffer,
    OrthographicCamera,
    PointLight,
    _environment,
    fit,
    relight,
)
from jaxfx.relight._ggx import mean_lobe
from tests.relight.test_ggx import furnace
from tests.test_harmonics import functions


SIZE = 12
CAMERA = OrthographicCamera(SIZE / 2, [SIZE / 2, SIZE / 2], np.eye(4))
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def lamps(way):
    """A sky over ground, a window and a lamp small and bright."""
    sky = 0.4 + 0.3 * np.tanh(3 * way[..., 1])
    return (
        sky[..., None] * [0.6, 0.8, 1.0]
        + spot(way, [0.5, 0.4, -1.0], 12)[..., None] * [4, 3, 2]
        + spot(way, [-1.0, 0.3, 0.2], 30)[..., None] * [1, 3, 5]
    )


def clouds(way):
    """A sky over ground, brighter about a sun behind clouds."""
    sky = 0.4 + 0.3 * np.tanh(3 * way[..., 1])
    return sky[..., None] * [0.6, 0.8, 1.0] + spot(way, [0.5, 0.4, -1], 4)[..., None] * [
        2,
        2,
        1,
    ]


def spot(way, at, sharp):
    return np.exp(sharp * (way @ np.asarray(at) / np.linalg.norm(at) - 1))


def directions(height):
    """Of the texels of a picture, by its definition, and their solid angles."""
    below, right = np.meshgrid(
        np.arange(height) + 0.5, np.arange(2 * height) + 0.5, indexing="ij"
    )
    b, a = np.pi * (0.5 - below / height), np.pi * (right / height - 1)
    way = [np.cos(b) * np.sin(a), np.sin(b), -np.cos(b) * np.cos(a)]
    return np.stack(way, axis=-1), np.cos(b) * (np.pi / height) ** 2


def ball(metallic, roughness, shader=3):
    """A ball of one material that fills the picture, seen along z."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 2 - 1
    inside = x * x + y * y < 0.95
    front = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    normal = np.where(inside[..., None], np.stack([x, y, -front], axis=-1), 0)
    depth = np.where(inside, 3 - front, np.inf)
    full = lambda value: np.full((SIZE, SIZE), value)
    color = np.broadcast_to([0.9, 0.7, 0.5], (SIZE, SIZE, 3))
    gbuffer = GBuffer.metallic_roughness(color, full(metallic), full(roughness), normal, depth)
    number = np.where(inside, shader, -1)
    return GBuffer(**vars(gbuffer) | {"shader": number}), normal, inside


def brute_force(radiance, normal, color, metallic, roughness, rotation=TURN, height=96):
    """What a pixel shows by glTF's closed form, summed over all directions."""
    way, solid_angle = (part.reshape(-1, *part.shape[2:]) for part in directions(height))
    light, way = radiance(way), way @ rotation.T
    to_camera = np.array([0, 0, -1.0])
    n_l, n_v = way @ normal, normal @ to_camera
    above = n_l > 0
    way, light, n_l, solid_angle = way[above], light[above], n_l[above], solid_angle[above]
    halfway = (way + to_camera) / np.linalg.norm(way + to_camera, axis=-1, keepdims=True)
    n_h, v_h = halfway @ normal, halfway @ to_camera
    square = roughness**4
    root = lambda c: np.sqrt(square + (1 - square) * c * c)
    lobe = square / (np.pi * (n_h**2 * (square - 1) + 1) ** 2)
    lobe = lobe * 0.5 / (n_l * root(n_v) + n_v * root(n_l))
    base = np.array(color)
    f0 = 0.04 * (1 - metallic) + base * metallic
    fresnel = f0 + (1 - f0) * ((1 - v_h) ** 5)[:, None]
    brdf = (1 - fresnel) * base * (1 - metallic) / np.pi + fresnel * lobe[:, None]
    return (brdf * light * (n_l * solid_angle)[:, None]).sum(axis=0)


def psnr(image, expected):
    return 10 * np.log10(expected.max() ** 2 / np.mean((image - expected) ** 2))


LIGHTS = {of: EnvironmentLight(of(directions(64)[0]), TURN) for of in (lamps, clouds)}


def test_coefficients_are_the_integrals():
    way, solid_angle = directions(256)
    expected = np.einsum("hwc,hwk,hw->kc", lamps(way), functions(way), solid_angle)
    found = np.asarray(LIGHTS[lamps].coefficients)
    np.testing.assert_allclose(found[:9], expected, atol=2e-3)


def sun(way):
    """A bright sun of five degrees in an even sky."""
    return 0.3 + spot(way, [-0.3, 0.8, 0.5], 300)[..., None] * [40, 34, 26]


LIGHTS[sun] = EnvironmentLight(sun(directions(64)[0]), TURN)


@pytest.mark.parametrize(("radiance", "least"), [(clouds, 60), (lamps, 60), (sun, 50)])
def test_diffuse_light(radiance, least):
    gbuffer, normal, inside = ball(0.0, 1.0, shader=0)
    image = np.asarray(relight.shade(gbuffer, CAMERA, LIGHTS[radiance]))
    way, solid_angle = directions(64)
    turned, light = way @ TURN.T, radiance(way)
    expected = np.zeros((SIZE, SIZE, 3))
    for j, i in np.argwhere(inside):
        cosine = np.maximum(turned @ normal[j, i], 0) * solid_angle / np.pi
        expected[j, i] = np.asarray(gbuffer.diffuse)[j, i] * np.einsum(
            "hw,hwc->c", cosine, light
        )
    found = psnr(image[inside], expected[inside])
    print(f"diffuse {radiance.__name__} {found:.1f} dB")
    assert found > least


# The mirror image of a lamp in a rough metal is drawn out at grazing angles, not round.
@pytest.mark.parametrize(
    ("radiance", "metallic", "roughness", "least"),
    [
        (lamps, 1.0, 0.2, 48),
        (lamps, 1.0, 0.5, 38),
        (lamps, 1.0, 0.65, 37),
        (lamps, 1.0, 0.8, 36),
        (lamps, 1.0, 1.0, 38),
        (lamps, 0.0, 0.2, 55),
        (lamps, 0.0, 0.8, 55),
        (clouds, 1.0, 0.2, 48),
        (clouds, 1.0, 0.5, 45),
        (clouds, 1.0, 0.8, 41),
    ],
)
def test_ggx_highlights(radiance, metallic, roughness, least):
    gbuffer, normal, inside = ball(metallic, roughness)
    image = np.asarray(relight.shade(gbuffer, CAMERA, LIGHTS[radiance]))
    expected = np.zeros((SIZE, SIZE, 3))
    for j, i in np.argwhere(inside):
        expected[j, i] = brute_force(
            radiance, normal[j, i], [0.9, 0.7, 0.5], metallic, roughness
        )
    found = psnr(image[inside], expected[inside])
    print(f"GGX {radiance.__name__} metallic {metallic} roughness {roughness} {found:.1f} dB")
    assert found > least


def test_a_mirror_shows_the_picture():
    """At texels' centres, where nothing is interpolated, of roughness 0: row by row."""
    rng = np.random.default_rng(0)
    picture = rng.uniform(size=(8, 16, 3))
    light = EnvironmentLight(picture)
    way, _ = directions(8)
    flat = way.reshape(1, -1, 3)
    camera = OrthographicCamera(1.0, [0.5, 0.5], np.eye(4))
    normal = flat + np.array([0, 0, -1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    one = np.ones(normal.shape[:2])
    gbuffer = GBuffer.metallic_roughness(np.ones_like(normal), one, 0 * one, normal, one)
    image = np.asarray(relight.shade(gbuffer, camera, light))[0]
    clear = normal[0, :, 2] < -0.2  # Elsewhere the table's first cells are off by more.
    np.testing.assert_allclose(image[clear], picture.reshape(-1, 3)[clear], atol=0.1)


@pytest.mark.parametrize("roughness", [0.2, 0.7])
def test_light_that_is_the_same_from_everywhere_is_a_furnace(roughness):
    """The split sum is exact there: against the sum over suns."""
    light = EnvironmentLight(np.ones((4, 8, 3)))
    for facing in (0.3, 0.8):
        normal = np.array([[[np.sqrt(1 - facing**2), 0, -facing]]])
        one = np.ones((1, 1))
        camera = OrthographicCamera(1.0, [0.5, 0.5], np.eye(4))
        for metallic in (0.0, 1.0):
            gbuffer = GBuffer.metallic_roughness(
                np.full((1, 1, 3), 0.7), metallic * one, roughness * one, normal, one
            )
            expected = furnace(facing, roughness, metallic, 0.7)
            image = relight.shade(gbuffer, camera, light)
            np.testing.assert_allclose(image, expected, rtol=3e-3)


def test_the_table_is_between_0_and_1():
    cosine, roughness = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 30))
    lobe = jax.tree.map(np.asarray, jax.jit(mean_lobe)(cosine, roughness))
    for part in lobe[:4]:
        assert (part >= -1e-3).all()
    for part in lobe[:3]:
        assert (part <= 1.001).all()
    assert (lobe.mirrored <= 1.03).all()
    assert (lobe.roughness >= 0).all()
    assert (lobe.roughness <= 2).all()
    assert (lobe.specular + lobe.grazing <= 1.001).all()


def test_a_turn_is_a_turned_picture_and_an_edit():
    """A quarter about y moves the columns by a quarter of the picture."""
    picture = lamps(directions(16)[0])
    quarter = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    plain = EnvironmentLight(picture)
    rolled = EnvironmentLight(np.roll(picture, -8, axis=1))
    gbuffer, _, _ = ball(0.5, 0.3)
    turned = plain.turned(quarter)
    expected = relight.shade(gbuffer, CAMERA, rolled)
    np.testing.assert_allclose(
        relight.shade(gbuffer, CAMERA, turned), expected, rtol=1e-9, atol=1e-9
    )
    others = [PointLight([0, 0, 0], [1, 2, 3]), AmbientLight([0.1, 0.1, 0.1])]
    state = relight.start(gbuffer, CAMERA, [plain, *others])
    fresh = relight.render(gbuffer, CAMERA, [rolled, *others])
    np.testing.assert_allclose(state.edit(0, turned).image, fresh, rtol=1e-9, atol=1e-9)


def test_both_modes_equal_differences():
    rng = np.random.default_rng(1)
    gbuffer, _, inside = ball(0.5, 0.37)
    weight = rng.normal(size=(SIZE, SIZE, 3)) * inside[..., None]
    picture = rng.uniform(0.1, 1, (8, 16, 3))

    def score(picture, color, angle, specular):
        c, s = jnp.cos(angle), jnp.sin(angle)
        zero, one = jnp.zeros(()), jnp.ones(())
        rows = [[c, zero, s], [zero, one, zero], [-s, zero, c]]
        light = EnvironmentLight(picture, jnp.stack([jnp.stack(row) for row in rows]), color)
        cache = GBuffer(**vars(gbuffer) | {"specular": specular})
        return jnp.sum(weight * relight.shade(cache, CAMERA, light))

    arguments = (
        picture,
        np.array([1.0, 0.5, 2.0]),
        np.array(0.3),
        np.asarray(gbuffer.specular),
    )
    along = tuple(rng.normal(size=leaf.shape) for leaf in arguments)
    compiled = jax.jit(score)
    moved = lambda step: [leaf + step * way for leaf, way in zip(arguments, along, strict=True)]
    expected = (float(compiled(*moved(1e-7))) - float(compiled(*moved(-1e-7)))) / 2e-7
    forward = jax.jit(lambda *at: jax.jvp(score, at, along)[1])(*arguments)
    reverse = jax.jit(jax.grad(score, (0, 1, 2, 3)))(*arguments)
    products = [np.vdot(slope, way) for slope, way in zip(reverse, along, strict=True)]
    np.testing.assert_allclose(forward, expected, rtol=1e-5)
    np.testing.assert_allclose(sum(products), forward, rtol=1e-10)


def test_straight_up_and_down_are_finite():
    light = EnvironmentLight(lamps(directions(8)[0]))

    def score(arguments, light):
        gbuffer = GBuffer.metallic_roughness(*arguments)
        camera = OrthographicCamera(1.0, [0.5, 0.5], np.eye(4))
        return jnp.sum(relight.shade(gbuffer, camera, light))

    value_and_slopes = jax.jit(jax.value_and_grad(score, (0, 1)))
    for way in (1.0, -1.0):
        # Mirrored straight up: the normal is halfway to the camera, on -z.
        normal = np.array([[[0, way, -1]]]) / np.sqrt(2)
        one = np.ones((1, 1))
        arguments = np.full((1, 1, 3), 0.5), one, 0.1 * one, normal, one
        found = value_and_slopes(arguments, light)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_errors_name_the_argument():
    make = inspect.unwrap(EnvironmentLight)
    good = np.ones((4, 8, 3))
    for wrong in (np.ones((4, 9, 3)), np.ones((4, 8)), np.ones((0, 0, 3))):
        with pytest.raises(ValueError, match=r"`EnvironmentLight\(image\)` must have shape"):
            make(wrong)
    for number in (-1.0, np.nan, np.inf):
        wrong = good.copy()
        wrong[1, 2] = number
        with pytest.raises(
            ValueError, match=r"`EnvironmentLight\(image\)` must be finite, 0 or"
        ):
            make(wrong)
    with pytest.raises(
        ValueError, match=r"`EnvironmentLight\(world_from_image\)` must be a rotation"
    ):
        make(good, np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match=r"`turned\(world_from_image\)` must be a rotation"):
        make(good).turned(2 * np.eye(3))


@pytest.mark.full
def test_a_fit_finds_its_color():
    gbuffer, _, _ = ball(1.0, 0.4)
    picture = clouds(directions(16)[0])
    photograph = relight.shade(
        gbuffer, CAMERA, EnvironmentLight(picture, TURN, [2.0, 1.5, 0.5])
    )
    start = [EnvironmentLight(picture, TURN)]
    fitted = fit.lights(photograph, gbuffer, CAMERA, start, loss="squares")
    np.testing.assert_allclose(fitted.lights[0].color, [2.0, 1.5, 0.5], rtol=1e-6)


@pytest.mark.parametrize(
    ("dtype", "value", "slope"), [("float32", 4e-7, 4e-5), ("float64", 0, 0)]
)
def test_angles_and_their_slopes_are_the_librarys(dtype, value, slope):
    """All around, on the axes too: float32's own rounding is 2.4e-7 at the most."""
    around = np.linspace(-np.pi, np.pi, 721)[1:]
    y, x = np.sin(around).astype(dtype), np.cos(around).astype(dtype)
    on_axes = np.array([[0, 1], [1, 0], [-1, 0], [0, -1]], dtype)
    y, x = np.append(y, on_axes[:, 0]), np.append(x, on_axes[:, 1])
    angle = inspect.unwrap(_environment._angle)
    found = np.asarray(jax.jit(angle)(y, x))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, np.arctan2(y, x), atol=value + 1e-15)
    square = y.astype(float) ** 2 + x.astype(float) ** 2
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(mode(angle, argnums=(0, 1))))(y, x)
        for one, expected in zip(slopes, (x / square, -y / square), strict=True):
            np.testing.assert_allclose(one, expected, atol=slope + 1e-12)
