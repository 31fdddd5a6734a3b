"""Separable against a plain loop over lines, pixels and taps."""

import inspect
import math

import jax
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, dof, metrics, relight, scene


def clamp(t):
    return min(max(t, 0.0), 1.0)


def loop(image, defocus, epsilon):
    """One pass along every row."""
    result = np.empty_like(image)
    height, width = defocus.shape
    coc = np.abs(defocus)
    for j, q in np.ndindex(height, width):
        total, weights = 0, 0
        for p in range(width):
            length = max(math.sqrt(3) / 2 * coc[j, p], 1.0)
            overlap = min(q - p + 0.5, length / 2) - max(q - p - 0.5, -length / 2)
            k = 1.0
            if defocus[j, p] >= 0:
                rise = clamp((coc[j, p] - coc[j, q]) / epsilon)
                k = 1 - rise * (1 - clamp(coc[j, q] / epsilon - 1))
            weight = k * max(overlap, 0) / length
            total, weights = total + weight * image[j, p], weights + weight
        result[j, q] = total / weights
    return result


@pytest.mark.parametrize(
    "lens", [ThinLens(0.3, 3.0, 60.0), FocusPlanes(1.0, 3.0, 8.0, 9.0)], ids=["thin", "planes"]
)
def test_equals_the_loop(lens):
    rng = np.random.default_rng(0)
    image, depth = rng.random((11, 14, 3)), rng.uniform(1.5, 10, (11, 14))
    depth[rng.random((11, 14)) < 0.2] = np.inf
    defocus = np.clip(np.asarray(lens.defocus(jax.numpy.asarray(depth))), -9, 9)
    once = loop(image, defocus, 1.7)
    expected = loop(once.swapaxes(0, 1), defocus.T, 1.7).swapaxes(0, 1)
    result = dof.separable(image, depth, lens, max_coc=9, epsilon=1.7)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("radius", [2.0, 6.0, 11.3])
def test_a_point_of_light_has_the_variance_of_its_disc(radius):
    image = np.zeros((41, 41, 1))
    image[20, 20] = 1
    lens = ThinLens(1.0, 1.0, 2 * radius)
    spread = np.asarray(dof.separable(image, np.full((41, 41), np.inf), lens, max_coc=24))
    assert spread.sum() == pytest.approx(1, abs=1e-12)
    x = np.arange(-20, 21)
    # A pixel, as the box that it is, adds at most a sixth of its area along each axis.
    variance = (spread[..., 0] * x**2).sum()
    assert 0 <= variance - radius**2 / 4 <= 1 / 6


def test_a_bad_pixel_spoils_its_square():
    rng = np.random.default_rng(0)
    image, depth = rng.random((40, 40, 3)), rng.uniform(1.5, 9, (40, 40))
    call = jax.jit(lambda *a: dof.separable(*a, ThinLens(0.3, 3.0, 60.0), max_coc=12.0))
    for bad_image, bad_depth in ((np.nan, 1.0), (np.inf, 1.0)):
        image[20, 20], depth[20, 20] = bad_image, bad_depth
        y, x = np.nonzero(np.isnan(call(image, depth)).any(axis=-1))
        assert max(np.abs(y - 20).max(), np.abs(x - 20).max()) <= 0.44 * 12 + 1
        assert np.isnan(call(image, depth)[20, 20]).all()


def test_a_negative_epsilon_is_named():
    image, depth = np.ones((3, 3, 1)), np.ones((3, 3))
    with pytest.raises(ValueError, match=r"`separable\(epsilon=...\)` must be 0 or positive"):
        inspect.unwrap(dof.separable)(image, depth, ThinLens(1.0, 2.0, 3.0), epsilon=-1.0)


@pytest.mark.full
def test_before_an_empty_background_it_lies_far_below_layered():
    trimesh = pytest.importorskip("trimesh", reason="pip install -e '.[scene]'")
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    shades = np.random.default_rng(0).random((len(sphere.vertices), 3)) * 255
    sphere.visual = trimesh.visual.ColorVisuals(sphere, vertex_colors=shades.astype(np.uint8))
    mesh = scene.from_trimesh(sphere)
    camera = scene.default_camera(mesh, height=120, width=160)
    lights = scene.default_lights(camera)

    def seen_by(camera):
        gbuffer = scene.gbuffer(mesh, camera, height=120, width=160)
        return relight.render(gbuffer, camera, lights), gbuffer.depth

    image, depth = seen_by(camera)
    near = float(depth.min())
    lens = ThinLens.from_camera(camera, aperture=0.15 * near, focus_distance=1.02 * near)
    reference = dof.accumulate(lambda at: seen_by(at)[0], camera, lens, samples=128).image
    layered, separable = (
        float(metrics.psnr(effect(image, depth, lens), reference))
        for effect in (dof.layered, dof.separable)
    )
    assert 10 < layered - separable < 13
