"""A light of nine coefficients against sums over many suns, and found again by a fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import (
    DirectionalLight,
    GBuffer,
    PinholeCamera,
    SphericalHarmonicsLight,
    fit,
    relight,
)
from tests.relight.test_ggx import CAMERA, SIZE, materials, with_shader


def functions(way):
    """The nine functions at unit vectors, from the Legendre polynomials (Sloan 2008)."""
    x, y, z = np.moveaxis(way, -1, 0)
    return np.stack(
        [
            0 * x + 0.5 / np.sqrt(np.pi),
            *(np.sqrt(3 / (4 * np.pi)) * axis for axis in (y, z, x)),
            np.sqrt(15 / np.pi) / 2 * x * y,
            np.sqrt(15 / np.pi) / 2 * y * z,
            np.sqrt(5 / np.pi) / 4 * (3 * z * z - 1),
            np.sqrt(15 / np.pi) / 2 * x * z,
            np.sqrt(15 / np.pi) / 4 * (x * x - y * y),
        ],
        axis=-1,
    )


def sphere(rows=48):
    """Directions over the sphere and their solid angles: Gauss-Legendre in the height."""
    height, weight = np.polynomial.legendre.leggauss(rows)
    angle = (np.arange(2 * rows) + 0.5) * np.pi / rows
    z, angle = np.meshgrid(height, angle, indexing="ij")
    across = np.sqrt(1 - z**2)
    ways = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)
    return ways.reshape(-1, 3), np.repeat(weight * np.pi / rows, 2 * rows)


def make(seed):
    """A cache of shaders 0 to 3 and a light."""
    rng = np.random.default_rng(seed)
    gbuffer = GBuffer.metallic_roughness(*materials(rng))
    shader = rng.permutation(20).reshape(SIZE) % 5 - 1
    light = SphericalHarmonicsLight(rng.normal(size=(9, 3)))
    return with_shader(gbuffer, shader), light


def test_equals_the_sum_over_all_directions():
    """For Lambert, Phong and Blinn; the cosine's kink takes digits from the quadrature."""
    gbuffer, light = make(0)
    image = np.asarray(relight.shade(gbuffer, CAMERA, light))
    ways, solid_angle = sphere()
    radiance = functions(ways) @ np.asarray(light.coefficients)
    shader = np.asarray(gbuffer.shader)
    for j, i in np.ndindex(SIZE):
        cosine = np.maximum(ways @ np.asarray(gbuffer.normal)[j, i], 0)
        falls_in = (radiance * (cosine * solid_angle)[:, None]).sum(axis=0) / np.pi
        expected = np.asarray(gbuffer.diffuse)[j, i] * falls_in
        if shader[j, i] == -1:
            assert not image[j, i].any()
        elif shader[j, i] < 3:
            np.testing.assert_allclose(image[j, i], expected, rtol=2e-3, atol=2e-3)


def test_of_the_same_from_everywhere_a_ggx_surface_keeps_its_diffuse_part():
    color, _, roughness, normal, depth = materials(np.random.default_rng(1))
    gbuffer = GBuffer.metallic_roughness(color, np.zeros(SIZE), roughness, normal, depth)
    same = SphericalHarmonicsLight(np.sqrt(4 * np.pi) * np.eye(9)[:, :1] * np.ones(3))
    image = np.asarray(relight.shade(gbuffer, CAMERA, same))
    inverse = np.linalg.inv(np.asarray(CAMERA.intrinsics))
    ways, solid_angle = sphere(96)
    for j, i in ((0, 0), (2, 3), (3, 1)):
        to_camera = -inverse @ [i + 0.5, j + 0.5, 1]
        to_camera /= np.linalg.norm(to_camera)
        n = normal[j, i]
        kept = 0
        for way, share in zip(ways, solid_angle, strict=True):
            if n @ way > 0:
                halfway = (way + to_camera) / np.linalg.norm(way + to_camera)
                fresnel = 0.04 + 0.96 * (1 - halfway @ to_camera) ** 5
                kept += (1 - fresnel) * (n @ way) * share / np.pi
        np.testing.assert_allclose(image[j, i], color[j, i] * kept, rtol=1e-3)


def test_linear_edited_and_carried_on():
    gbuffer, light = make(2)
    coefficients = np.asarray(light.coefficients)
    other = SphericalHarmonicsLight(2 * coefficients[::-1])
    both = SphericalHarmonicsLight(coefficients + 2 * coefficients[::-1])
    one, two, sum_of_both = (
        np.asarray(relight.shade(gbuffer, CAMERA, each)) for each in (light, other, both)
    )
    np.testing.assert_allclose(one + two, sum_of_both, rtol=1e-12, atol=1e-12)
    sun = DirectionalLight([0.1, 0.2, 1.0], [1.0, 1.0, 1.0])
    state = relight.start(gbuffer, CAMERA, [light, sun])
    expected = relight.render(gbuffer, CAMERA, [other, sun])
    np.testing.assert_allclose(state.edit(0, other).image, expected, rtol=1e-12, atol=1e-12)


def test_indirect_light_of_it_is_that_of_its_irradiance():
    from jaxfx import Transfer

    gbuffer, light = make(3)
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(6, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    receive, send = rng.uniform(size=(*SIZE, 2)), rng.uniform(size=(2, 6))
    diffuse = rng.uniform(size=(6, 3))
    transfer = Transfer(receive, send, rng.normal(size=(6, 3)), normal, diffuse)
    left = np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])[:, None] * np.asarray(light.coefficients)
    sent = send @ (diffuse * (functions(normal) @ left))
    expected = np.asarray(gbuffer.diffuse) * (receive @ sent)
    expected[np.asarray(gbuffer.shader) < 0] = 0
    image = relight.indirect(gbuffer, transfer, [light])
    np.testing.assert_allclose(image, expected, rtol=1e-10, atol=1e-12)


def test_both_modes_equal_differences():
    gbuffer, light = make(4)
    rng = np.random.default_rng(4)
    weight = rng.normal(size=(*SIZE, 3))
    names = ("diffuse", "specular", "normal")

    def score(images, light):
        fields = vars(gbuffer) | dict(zip(names, images, strict=True))
        return jnp.sum(weight * relight.shade(GBuffer(**fields), CAMERA, light))

    arguments = jax.device_get((tuple(getattr(gbuffer, name) for name in names), light))
    along = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), arguments)
    compiled = jax.jit(score)
    moved = lambda step: jax.tree.map(lambda leaf, way: leaf + step * way, arguments, along)
    expected = (float(compiled(*moved(1e-6))) - float(compiled(*moved(-1e-6)))) / 2e-6
    forward = jax.jit(lambda *at: jax.jvp(score, at, along)[1])(*arguments)
    reverse = jax.jit(jax.grad(score, (0, 1)))(*arguments)
    products = jax.tree.leaves(jax.tree.map(np.vdot, reverse, along))
    np.testing.assert_allclose(forward, expected, rtol=1e-6)
    np.testing.assert_allclose(sum(products), forward, rtol=1e-10)


def test_a_zero_normal_is_dark():
    gbuffer, light = make(5)
    fields = vars(gbuffer) | {"normal": np.zeros((*SIZE, 3))}
    assert not np.asarray(relight.shade(GBuffer(**fields), CAMERA, light)).any()


def ball(size=16):
    """A white ball that fills the picture, of Lambert."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x * x + y * y < 1
    front = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    normal = np.where(inside[..., None], np.stack([x, y, -front], axis=-1), 0)
    white, depth = np.ones((size, size, 3)), np.where(inside, 3 - front, np.inf)
    shader = np.where(inside, 0, -1)
    return GBuffer(white, shader, white, white, 0 * white, normal, depth, np.ones_like(x))


# Half of the ball is seen: of directions behind it the nine say less, but they do say it.
def test_a_fit_finds_all_nine_exactly_and_says_how_sure_it_is():
    gbuffer, camera = ball(), PinholeCamera.from_fov(0.6, height=16, width=16)
    rng = np.random.default_rng(6)
    light = SphericalHarmonicsLight(rng.normal(0, 0.3, (9, 3)) + np.eye(9)[:, :1] * 3)
    photograph = relight.shade(gbuffer, camera, light)
    start = [SphericalHarmonicsLight(np.zeros((9, 3)))]
    options = {"parameters": ["color"], "loss": "squares", "throw": False}
    fitted = fit.lights(photograph, gbuffer, camera, start, **options)
    np.testing.assert_allclose(fitted.lights[0].coefficients, light.coefficients, atol=1e-9)
    assert fitted.standard_errors[0]["color"].shape == (9, 3)
    noisy = np.asarray(photograph) + 0.02 * rng.normal(size=photograph.shape)
    fitted = fit.lights(noisy, gbuffer, camera, start, **options)
    miss = np.asarray(fitted.lights[0].coefficients) - np.asarray(light.coefficients)
    errors = np.asarray(fitted.standard_errors[0]["color"])
    assert np.isfinite(errors).all()
    ratio = np.sqrt(np.mean((miss / errors) ** 2))
    assert 0.5 < ratio < 2, ratio


@pytest.mark.full
def test_a_fit_beside_a_sun():
    gbuffer, camera = ball(), PinholeCamera.from_fov(0.6, height=16, width=16)
    sky = SphericalHarmonicsLight(np.eye(9)[:, :1] * np.array([1.0, 1.5, 2.0]))
    sun = DirectionalLight([0.5, 0.4, 1.0], [2.0, 1.5, 1.0])
    photograph = relight.render(gbuffer, camera, [sky, sun])
    start = [
        SphericalHarmonicsLight(np.zeros((9, 3))),
        DirectionalLight([0.4, 0.5, 1.0], [1.0, 1.0, 1.0]),
    ]
    fitted = fit.lights(photograph, gbuffer, camera, start, loss="squares", throw=False)
    way = fitted.lights[1].direction
    np.testing.assert_allclose(
        way / np.linalg.norm(way), sun.direction / np.linalg.norm(sun.direction), atol=1e-3
    )
    np.testing.assert_allclose(fitted.lights[1].color, sun.color, rtol=0.02)


def test_errors_name_the_argument():
    with pytest.raises(
        ValueError, match=r"`SphericalHarmonicsLight\(coefficients\)` must have"
    ):
        SphericalHarmonicsLight(np.zeros((3, 9)))
    with pytest.raises(ValueError, match=r"`SphericalHarmonicsLight\(coefficients\)` must be"):
        SphericalHarmonicsLight(np.full((9, 3), np.inf))
