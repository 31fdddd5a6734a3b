"""Against a path tracer: Mitsuba's light on the still life, every surface Lambert, and on balls
of GGX, under a sun and in surroundings."""

import numpy as np
import pytest

from jaxfx import DirectionalLight, EnvironmentLight, GBuffer, metrics, relight, scene
from jaxfx._sampling import pixel_centers


pytest.importorskip("mitsuba", reason="Mitsuba comes with the `bench` extra.")
from benchmarks.scenes import relight_mitsuba as mitsuba, relight_truth as truth
from tests import test_environment as balls


SIZE = (48, 64)


@pytest.fixture(scope="module")
def stage():
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=SIZE[0], width=SIZE[1])
    return mesh, camera, truth.lambert(mesh, camera, SIZE)


def all_of(stage, shadows):
    """Mitsuba's image under all lights."""
    mesh, camera, _ = stage
    each = [truth.direct(mesh, camera, v, SIZE, shadows=shadows) for v in truth.LIGHTS.values()]
    return np.sum(each, axis=0)


@pytest.mark.full
def test_direct_light_without_shadows_is_the_path_tracers_to_rounding(stage):
    """Some five pixels of 3072 have their centre on an edge and show another face there."""
    _, camera, gbuffer = stage
    image = np.asarray(relight.render(gbuffer, camera, [*truth.LIGHTS.values()]))
    expected = all_of(stage, shadows=False)
    error = np.abs(image - expected).max(axis=-1) / expected.max()
    assert (error > 1e-4).sum() <= 20
    assert np.quantile(error, 0.99) < 1e-5
    assert metrics.psnr(image, expected) > 40


@pytest.mark.full
def test_direct_light_with_shadows_is_the_path_tracers_to_rounding(stage):
    mesh, camera, gbuffer = stage
    lights = [*truth.LIGHTS.values()]
    position = camera.unproject(pixel_centers(*SIZE), gbuffer.depth.astype(float))
    position = np.asarray(position)
    visible = [truth.unshadowed(mesh, position, light).astype(np.float32) for light in lights]
    image = np.asarray(relight.start(gbuffer, camera, lights, visibilities=visible).image)
    expected = all_of(stage, shadows=True)
    error = np.abs(image - expected).max(axis=-1) / expected.max()
    assert (error > 1e-4).sum() <= 30
    assert metrics.psnr(image, expected) > 38


@pytest.mark.full
@pytest.mark.parametrize("bounces", [1, 2])
def test_bounces_are_the_path_tracers_but_for_the_noise_of_both(bounces):
    size = (24, 32)
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=size[0], width=size[1])
    gbuffer, light = truth.lambert(mesh, camera, size), truth.LIGHTS["directional"]
    transfer = scene.transfer(mesh, gbuffer, camera, point_count=512, rank=64)
    lit = truth.unshadowed(mesh, np.asarray(transfer.position, float), light)
    find = lambda n: np.asarray(
        relight.indirect(gbuffer, transfer, [light], visibilities=[lit], bounces=n)
    )
    image = find(bounces)
    expected, noise = truth.bounced(mesh, camera, light, size, 128, bounces=bounces)
    error, size = (np.sqrt(np.mean(v**2)) for v in (image - expected, expected))
    print(
        bounces,
        image.mean(),
        find(1).mean(),
        expected.mean(),
        error / size,
        np.sqrt(np.mean(noise**2)) / size,
    )
    assert np.sqrt(np.mean(noise**2)) < 0.2 * size
    assert error < 0.4 * size
    assert image.mean() == pytest.approx(expected.mean(), rel=0.12)


COLOR = (0.9, 0.7, 0.5)


@pytest.mark.parametrize("direction", [(0.5, 0.6, 1.0), (1.0, 0.3, -0.5)])
@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.8])
@pytest.mark.full
def test_ggx_is_the_path_tracers_to_rounding(direction, roughness):
    """glTF's formula of Mitsuba's own GGX and Smith terms, of a metal and a dielectric."""
    light = DirectionalLight(direction, [3.0, 2.0, 1.0])
    for metallic in (1.0, 0.0):
        gbuffer, normals, inside = balls.ball(metallic, roughness)
        material = mitsuba.Gltf(COLOR, metallic, roughness)
        expected = mitsuba.under_sun(material, direction, [3.0, 2.0, 1.0], normals, inside)
        image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))
        assert balls.psnr(image[inside], np.pi * expected[inside]) > 90


@pytest.mark.parametrize(("roughness", "least"), [(0.2, 100), (0.5, 60), (0.8, 40)])
@pytest.mark.full
def test_a_metal_is_nearly_mitsubas_own(roughness, least):
    """Its `principled` and `roughconductor` take Smith's two terms for independent, where
    glTF's are correlated: the rougher, the more they differ."""
    direction = (0.5, 0.6, 1.0)
    light = DirectionalLight(direction, [1.0, 1.0, 1.0])
    metal, normals, inside = balls.ball(1.0, roughness)
    white = GBuffer(**vars(metal) | {"specular": np.ones_like(metal.specular)})
    own = {
        "principled": {
            "base_color": mitsuba.rgb(COLOR),
            "metallic": 1.0,
            "roughness": roughness,
        },
        "roughconductor": {
            "distribution": "ggx",
            "alpha": roughness**2,
            "material": "none",
        },
    }
    for gbuffer, (plugin, options) in zip((metal, white), own.items(), strict=True):
        material = mitsuba.Own(plugin, **options)
        expected = mitsuba.under_sun(material, direction, [1, 1, 1], normals, inside)
        image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))
        assert balls.psnr(image[inside], np.pi * expected[inside]) > least


@pytest.mark.parametrize("roughness", [None, 0.2, 0.5, 0.8])
@pytest.mark.full
def test_surroundings_are_the_path_tracers(roughness):
    """A Lambert ball to 45 dB, metals to 35 dB."""
    is_metal = roughness is not None
    gbuffer, normals, inside = balls.ball(float(is_metal), roughness or 1, 3 * is_metal)
    if is_metal:
        material = mitsuba.Gltf(COLOR, 1.0, roughness)
    else:
        material = mitsuba.Own("diffuse", reflectance=mitsuba.rgb(COLOR))
    light = EnvironmentLight(balls.lamps(balls.directions(64)[0]), balls.TURN)
    emitter = mitsuba.surroundings(balls.lamps, balls.TURN, height=256)
    expected = mitsuba.in_surroundings(material, emitter, normals, inside, side=24)
    image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))
    found = balls.psnr(image[inside], expected[inside])
    print(f"roughness {roughness} {found:.1f} dB")
    assert found > (35 if is_metal else 45)
