"""Where GGX and light from all around fail: furnaces, grazing angles, suns in maps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import (
    DirectionalLight,
    EnvironmentLight,
    GBuffer,
    SphericalHarmonicsLight,
    relight,
)
from tests.cases.registry import Found, case
from tests.cases.relight_views import FRONT, one_pixel


# Of a pixel: N.V, roughness, metallic, shader.
FURNACES = {
    "metal, smooth": (0.5, 0.05, 1.0, 3),
    "metal, smooth, grazing": (0.1, 0.1, 1.0, 3),
    "metal, roughness 0.5": (0.5, 0.5, 1.0, 3),
    "metal, roughness 1": (0.5, 1.0, 1.0, 3),
    "white dielectric, from above": (1.0, 0.3, 0.0, 3),
    "white dielectric, 30 degrees up": (0.5, 0.1, 0.0, 3),
    "white dielectric, 6 degrees up": (0.1, 0.1, 0.0, 3),
    "white dielectric, shader 4, 30 degrees up": (0.5, 0.1, 0.0, 4),
    "white dielectric, shader 4, 6 degrees up": (0.1, 0.1, 0.0, 4),
}


@case(
    "relight",
    {"gained": 1e-3, "lost": None},
    FURNACES,
)
def white_furnace(method):
    """A white GGX pixel under white light from all sides, by a sun from each: what comes back
    beyond what falls in, and what is missing of it. glTF's mix takes from the diffuse part what
    facets turned halfway reflect, at grazing angles less than the highlight has, which shader 4
    takes. A rough metal lacks the light that meets it twice."""
    from tests.relight.test_ggx import furnace

    facing, roughness, metallic, shader = FURNACES[method]
    share = furnace(facing, roughness, metallic, 1.0, count=256, shader=shader)
    picture = np.full((4, 4, 3), share / 2)
    return Found({"gained": max(share - 1, 0.0), "lost": max(1 - share, 0.0)}, picture)


GRAZING: dict[str, tuple[GBuffer, DirectionalLight]] = {
    "roughness 0 at the peak": (
        one_pixel(3, roughness=0),
        DirectionalLight([0, 0, 1], [4, 8, 12]),
    ),
    "roughness 1e-3 off the peak": (
        one_pixel(3, roughness=1e-3),
        DirectionalLight([0.9, 0, 0.5], [4, 8, 12]),
    ),
    "camera in the surface's plane": (
        one_pixel(3, normal=(1, 0, 0)),
        DirectionalLight([-1, 0, 0.2], [4, 8, 12]),
    ),
    "both in the surface's plane": (
        one_pixel(3, normal=(1, 0, 0)),
        DirectionalLight([-1e-6, 0, 1], [4, 8, 12]),
    ),
    "light against the view": (one_pixel(3), DirectionalLight([0, 0, -1], [4, 8, 12])),
    "zero normal": (one_pixel(3, normal=(0, 0, 0)), DirectionalLight([0, 0, 1], [4, 8, 12])),
}


@jax.jit
def _slopes(arguments, shader):
    def score(arguments):
        floats, light = arguments
        return jnp.sum(relight.shade(eqx.combine(floats, shader), FRONT, light))

    along = jax.tree.map(lambda leaf: jnp.cos(7 * leaf + 1), arguments)
    return jax.jvp(jax.value_and_grad(score), (arguments,), (along,))


@case(
    "relight",
    {"not finite": 0.0},
    GRAZING,
    {
        "roughness 0 at the peak": "zero: in a roughness below 0.01",
        "roughness 1e-3 off the peak": "zero: in a roughness below 0.01",
        "light against the view": "zero: it is dark",
        "zero normal": "zero: it is dark",
    },
)
def degenerate_ggx(method):
    """In float32, of what a GGX pixel shows, its derivatives in all that makes it, and theirs
    along one direction: how many are not finite."""
    gbuffer, light = GRAZING[method]
    floats, shader = eqx.partition(gbuffer, eqx.is_inexact_array)
    arguments = jax.tree.map(lambda leaf: leaf.astype(np.float32), (floats, light))
    found = jax.tree.leaves(_slopes(arguments, shader))
    wrong = sum(int((~np.isfinite(leaf)).sum()) for leaf in found)
    return Found(
        {"not finite": float(wrong)}, np.clip(relight.shade(gbuffer, FRONT, light), 0, 12) / 12
    )


# Of a ball: the surroundings, the picture's rows, metallic, roughness.
BALLS = {
    "lamps, metal, roughness 0.2": ("lamps", 64, 1.0, 0.2),
    "lamps, metal, roughness 0.5": ("lamps", 64, 1.0, 0.5),
    "lamps, metal, roughness 0.8": ("lamps", 64, 1.0, 0.8),
    "lamps, dielectric, roughness 0.5": ("lamps", 64, 0.0, 0.5),
    "clouds, metal, roughness 0.8": ("clouds", 64, 1.0, 0.8),
    "lamps in 8 rows, metal, roughness 0.2": ("lamps", 8, 1.0, 0.2),
    "lamps in 8 rows, metal, roughness 0.15": ("lamps", 8, 1.0, 0.15),
}


@case(
    "relight",
    {"rms": 10 ** (-35 / 20)},
    BALLS,
    "exact, of the two approximations; biased: they are not the integral",
)
def environment_highlights(method):
    """A GGX ball in the surroundings, against the sum over all directions: rms error over the
    brightest value. The bound is 35 dB. A picture of few rows blurs what a mirror should show;
    blurs are round, where a rough metal's highlight is drawn out at grazing angles."""
    from tests import test_environment as balls

    name, rows, metallic, roughness = BALLS[method]
    radiance = getattr(balls, name)
    light = EnvironmentLight(radiance(balls.directions(rows)[0]), balls.TURN)
    gbuffer, normal, inside = balls.ball(metallic, roughness)
    image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))
    expected = np.zeros_like(image)
    color = [0.9, 0.7, 0.5]
    for j, i in np.argwhere(inside):
        expected[j, i] = balls.brute_force(
            radiance, normal[j, i], color, metallic, roughness, height=256
        )
    error = (image - expected)[inside] / expected.max()
    return Found({"rms": float(np.sqrt(np.mean(error**2)))}, image / expected.max())


# Surroundings, and the degree of the spherical harmonics.
SHADOWED = {
    "clouds, 9 numbers": ("clouds", 2),
    "clouds, 16 numbers": ("clouds", 3),
    "lamps, 9 numbers": ("lamps", 2),
    "lamps, 16 numbers": ("lamps", 3),
    "a sun, 16 numbers": ("sun", 3),
}


@case("relight", {"rms": 10 ** (-35 / 20)}, SHADOWED, needs="embreex")
def surroundings_in_shadow(method):
    """A floor beside a wall in surroundings, by `scene.occlusion`, against the sum over all
    directions: rms error over the brightest value; the bound is 35 dB. Few numbers make the
    shadow of a small lamp soft, and lose what a wall cuts sharply."""
    from jaxfx import scene
    from tests import test_environment as balls
    from tests.scene.test_occlusion import floor_and_wall, traced

    name, degree = SHADOWED[method]
    mesh, gbuffer, camera = floor_and_wall()
    radiance = getattr(balls, name)
    occlusion = scene.occlusion(mesh, gbuffer, camera, ray_count=1024, degree=degree)
    light = EnvironmentLight(radiance(balls.directions(32)[0]), balls.TURN)
    image = np.asarray(relight.shade(gbuffer, camera, light, occlusion))
    expected = traced(gbuffer, camera, radiance, balls.TURN)
    error = (image - expected) / expected.max()
    return Found({"rms": float(np.sqrt(np.mean(error**2)))}, image / expected.max())


@case(
    "relight",
    {"below 0": 0.01},
    ("clouds", "lamps", "a sun alone"),
    "exact: nothing is cut off at 0",
)
def harmonics_ring(method):
    """A white Lambert ball under nine coefficients of the surroundings: how far below 0 its
    darkest pixel is, over its brightest. Of a sun alone, far below: see it as a light of its
    own."""
    from tests import test_environment as balls

    way, _ = balls.directions(64)
    if method == "a sun alone":
        picture = np.repeat(balls.spot(way, [0.5, 0.4, -1.0], 2000)[..., None], 3, axis=-1)
    else:
        picture = getattr(balls, method)(way)
    coefficients = EnvironmentLight(picture).coefficients[:9]
    gbuffer, _, inside = balls.ball(0.0, 1.0, shader=0)
    # The side away from the sun, which the camera sees.
    turned = SphericalHarmonicsLight(coefficients)
    image = np.asarray(relight.shade(gbuffer, balls.CAMERA, turned))
    front = SphericalHarmonicsLight(
        coefficients * np.array([1.0, 1, -1, 1, 1, -1, 1, -1, 1])[:, None]
    )
    both = np.concatenate(
        [image[inside], np.asarray(relight.shade(gbuffer, balls.CAMERA, front))[inside]]
    )
    figure = float(max(-both.min(), 0) / both.max())
    return Found({"below 0": figure}, np.clip(image / both.max(), 0, 1))
