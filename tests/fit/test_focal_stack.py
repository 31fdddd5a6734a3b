"""Depth and image from focal stacks: walls whose circles of confusion are known, and rooms."""

import functools
import importlib.util
import inspect
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.special import j1

from jaxfx import ThinLens, dof, fit
from jaxfx.fit._stack_planes import compared, disc, explained, least_energy
from tests.helpers.forms import first


EXAMPLE = Path(__file__).parents[2] / "examples" / "focal_stack.py"
SIZE = 32
FOCI = (1.6, 2.0, 2.667, 4.0)
LENSES = [ThinLens(0.2, focus, 80.0) for focus in FOCI]


def texture(size=SIZE, seed=0, channels=1):
    """Noise of one to four pixels, band-limited, so that samples hold all there is."""
    noise = np.random.default_rng(seed).normal(size=(size, size, channels))
    fine, coarse = (ndimage.gaussian_filter(noise, (s, s, 0), mode="wrap") for s in (0.7, 1.5))
    image = 0.3 * fine + 0.4 * coarse
    return 0.5 + image - image.mean()


def through(image, depth, lens):
    """A periodic wall through a lens: the transform of the disc in closed form, by Bessel."""
    circle = float(lens.circle_of_confusion(depth))
    rho = np.hypot(*np.meshgrid(np.fft.fftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0])))
    x = np.pi * np.maximum(circle * rho, 1e-9)
    spectrum = np.fft.fft2(image, axes=(0, 1)) * (2 * j1(x) / x)[..., None]
    return np.fft.ifft2(spectrum, axes=(0, 1)).real


def stack(image, depth):
    return [through(image, depth, lens) for lens in LENSES]


QUICK = {"max_steps": 0, "throw": False}


def test_the_transform_of_a_disc_is_that_of_bessel():
    cycles = np.linspace(1e-3, 40, 300)
    expected = 2 * j1(np.pi * cycles) / (np.pi * cycles)
    np.testing.assert_allclose(jax.jit(disc)(cycles), expected, atol=1e-12)
    assert float(jax.jit(disc)(0.0)) == pytest.approx(1)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_noise_alone_tells_no_depth(noise):
    rng = np.random.default_rng(3)
    images = [0.5 + noise * rng.normal(size=(SIZE, SIZE, 1)) for _ in FOCI]
    found = fit.focal_stack(images, LENSES, min_depth=1.2, max_depth=5.0, **QUICK)
    assert float(found.share) < 0.04
    assert "determine the depth" in found.doubt


@pytest.mark.parametrize("depth", [1.8, 2.4, 3.3])
def test_a_textured_wall(depth):
    """Closed form; its middle, for mirrored borders are not those of a periodic wall."""
    image = texture()
    found = fit.focal_stack(stack(image, depth), LENSES, **QUICK)
    assert found.success, found.doubt
    middle = np.s_[7:-7, 7:-7]
    off = abs(np.asarray(found.depth)[middle] / depth - 1)
    assert np.median(off) < 0.01
    assert np.sqrt(np.mean((np.asarray(found.image) - image)[middle] ** 2)) < 0.02
    error = np.asarray(found.standard_errors["depth"])[middle]
    assert np.mean(off * depth < 1.96 * error) > 0.9


@first(("strength", "width"), [(16, 2), (45, 3)])
def test_a_thin_near_pole_is_told_from_the_wall_behind_it(strength, width):
    """Images that are in focus on the wall show it through the pole."""
    size = 48
    row, column = np.mgrid[:size, :size]
    pole = (np.abs(column - 0.1 * row - 21.1) < width / 2)[..., None].astype(float)
    wall, stripes = texture(size, 0, 3), texture(size, 100, 3) * [1, 0.3, 0.3] + [0.3, 0, 0]
    lenses = [ThinLens(strength / 80, focus, 80.0) for focus in FOCI]
    images = [
        through(pole * stripes, 1.5, lens)
        + (1 - through(pole, 1.5, lens)) * through(wall, 4.5, lens)
        for lens in lenses
    ]
    found = fit.focal_stack(images, lenses, min_depth=1.2, max_depth=6.0, **QUICK)
    true_depth, is_pole = np.where(pole[..., 0] > 0, 1.5, 4.5), pole[..., 0] > 0
    is_right = strength * np.abs(1 / np.asarray(found.depth) - 1 / true_depth) < 1
    assert is_right[is_pole].mean() > 0.95 and is_right[~is_pole].mean() > 0.95


def test_where_there_is_no_texture_nothing_is_told():
    """One half is even: there errors are large, and the mask says so; the other is told."""
    image = texture()
    image[:, : SIZE // 2] = 0.5
    rng = np.random.default_rng(1)
    noisy = [each + 0.002 * rng.normal(size=each.shape) for each in stack(image, 2.4)]
    found = fit.focal_stack(noisy, LENSES, **QUICK)
    even, told = np.s_[8:-8, 6:10], np.s_[8:-8, 22:-6]
    error = np.asarray(found.standard_errors["depth"])
    assert np.median(error[even]) > 3 * np.median(error[told])
    # Noise alone may pass for texture at a few pixels.
    assert np.asarray(found.determined)[even].mean() < 0.1
    assert np.asarray(found.determined)[told].all()


def test_what_is_explained_is_told_without_noise():
    """Half of the differences left are a quarter of their squares; noise does not count."""
    true = np.stack(stack(texture(), 2.4))
    noisy = true + 0.01 * np.random.default_rng(2).normal(size=true.shape)
    mean = np.mean(true, axis=0, keepdims=True)
    share = lambda images, drawn: float(explained(images, drawn))
    assert share(true, true) == pytest.approx(1)
    assert share(noisy, true) == pytest.approx(1, abs=0.02)
    for images, within in ((true, 0.03), (noisy, 0.1)):
        assert share(images, mean + 0 * true) == pytest.approx(0, abs=within)
        assert share(images, (mean + true) / 2) == pytest.approx(0.75, abs=within)
    assert share(0 * true, 0 * true) == -np.inf


def test_the_least_energy_is_that_of_the_best_plane_and_bends_with_the_lenses():
    """By a loop over the planes that are compared; derivatives by differences, in float64."""
    images = jnp.asarray(np.stack(stack(texture(20), 2.4)))
    strengths, foci = np.full(len(FOCI), 16.0), 1 / np.array(FOCI)
    candidates = jnp.linspace(0.2, 0.7, 7)
    least = jax.jit(functools.partial(least_energy, images, candidates=candidates, pad=4))
    energy = np.asarray(compared(images, strengths, foci, candidates, 4).energy)
    expected = energy.min(axis=0)
    for before, at, after in zip(energy, energy[1:], energy[2:], strict=False):
        bend = before - 2 * at + after
        vertex = np.maximum(at - (before - after) ** 2 / np.where(bend > 0, 8 * bend, 1), 0)
        is_least = (at <= before) & (at <= after)
        expected = np.where(is_least, np.minimum(expected, vertex), expected)
    # The noise that is allowed for: a thousandth of the images, in the window of 1.5 pixels.
    noise = 1e-6 * 2 * np.pi * 1.5**2 * np.mean(np.square(images))
    expected = np.log1p(expected / noise)
    np.testing.assert_allclose(least(strengths, foci), expected, rtol=1e-9)
    total = lambda strengths, foci: jnp.mean(least(strengths, foci))
    rng = np.random.default_rng(6)
    along = tuple(rng.normal(size=len(FOCI)) * size for size in (1, 0.05))
    forward = jax.jit(lambda *at: jax.jvp(total, at, along)[1])(strengths, foci)
    reverse = jax.jit(jax.grad(total, (0, 1)))(strengths, foci)
    moved = lambda h: np.mean(np.asarray(least(strengths + h * along[0], foci + h * along[1])))
    difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
    assert float(forward) == pytest.approx(difference, rel=1e-5)
    dot = sum(np.vdot(*pair) for pair in zip(reverse, along, strict=True))
    assert dot == pytest.approx(float(forward), rel=1e-9)


FAILURES = {
    "even": (lambda images: [0 * each + 0.5 for each in images], "determine the depth of 0 %"),
    "exposed": (lambda images: [images[0] * 1.2, *images[1:]], "exposure differs by"),
    "alike": (lambda images: [images[0]] * len(images), "of what varies"),
    "strangers": (
        lambda images: [texture(seed=seed) for seed in range(len(images))],
        "determine the depth of 0 %",
    ),
}


@pytest.mark.parametrize("name", FAILURES)
def test_failures_are_said(name):
    change, sentence = FAILURES[name]
    images = change(stack(texture(), 2.4))
    found = fit.focal_stack(images, LENSES, **QUICK)
    assert not found.success
    assert sentence in found.doubt
    with pytest.raises(RuntimeError, match=f"(?s)`focal_stack` found no depth.*{sentence}"):
        fit.focal_stack(images, LENSES, max_steps=0)


IMAGES = [np.full((8, 9, 1), 0.5)] * 4
WRONG = {
    "one image": ({"images": IMAGES[:1], "lenses": LENSES[:1]}, "two or more, got 1"),
    "no list": ({"images": 3.0}, "sequence of images, got float"),
    "shapes": ({"images": [*IMAGES[:3], np.zeros((8, 8, 1))]}, r"images\[3\]\)` must have the"),
    "not finite": ({"images": [*IMAGES[:3], np.full((8, 9, 1), np.nan)]}, "finite"),
    "integers": ({"images": [np.zeros((8, 9, 1), int)] * 4}, "floats"),
    "count": ({"lenses": LENSES[:3]}, "one for each of 4 images, got 3"),
    "no lens": ({"lenses": [*LENSES[:3], 2.0]}, "ThinLens, got float"),
    "equal": ({"lenses": LENSES[:1] * 4}, "differ by more than 0.5 pixels"),
    "pinholes": ({"lenses": [ThinLens(1e-3, f, 80.0) for f in FOCI]}, "differ by more"),
    "range": ({"min_depth": 3.0, "max_depth": 2.0}, "less than `max_depth`, got 3 and 2"),
    "depth": ({"min_depth": -1.0}, "positive and finite"),
    "effect": ({"effect": "gather"}, "one of"),
    "parameter": ({"parameters": ["focal_pixels"]}, "or none, got .'focal_pixels'"),
    "parameters": ({"parameters": ["aperture", "focus_distance"]}, "one of"),
    "smoothness": ({"smoothness": -1.0}, "0 or positive"),
    "steps": ({"max_steps": -1}, "integer from 0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    change, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(fit.focal_stack)(**{"images": IMAGES, "lenses": LENSES} | change)


@pytest.mark.full
def test_float32_stays():
    images = [each.astype(np.float32) for each in stack(texture(), 2.4)]
    found = fit.focal_stack(images, LENSES, **QUICK)
    error = found.standard_errors["depth"]
    assert {x.dtype for x in (found.image, found.depth, error)} == {np.dtype(np.float32)}
    assert abs(np.median(found.depth) / 2.4 - 1) < 0.01


@pytest.mark.full
def test_the_search_through_the_effect_explains_more():
    """Two walls, one before the other."""
    image, depth = texture(48, channels=3), np.full((48, 48), 3.0)
    depth[12:36, 12:36] = 1.9
    images = [dof.scatter(image, depth, lens) for lens in LENSES]
    found = fit.focal_stack(images, LENSES, max_steps=24, throw=False)
    assert found.losses[-1] < 0.9 * found.losses[0]


def two_walls():
    """Images of a wall at 4.2 before which another at 1.8 hides a half, and the true depth."""
    near, far = texture(64, 1, 3), texture(64, 2, 3)
    cover = (np.arange(64) < 32)[None, :, None] * np.ones((64, 1, 1))
    images = [
        through(cover * near, 1.8, lens)
        + (1 - through(cover, 1.8, lens)) * through(far, 4.2, lens)
        for lens in LENSES
    ]
    return images, np.where(cover[..., 0] > 0, 1.8, 4.2)


@pytest.mark.full
@pytest.mark.parametrize("ratio", [0.75, 1.3])
def test_apertures_are_found(ratio):
    images, depth = two_walls()
    start = [ThinLens(ratio * 0.2, focus, 80.0) for focus in FOCI]
    found = fit.focal_stack(images, start, parameters={"aperture"}, **QUICK)
    assert found.success, found.doubt
    apertures = np.array([float(lens.aperture) for lens in found.lenses])
    np.testing.assert_allclose(apertures, 0.2, rtol=0.01)
    assert found.standard_errors["aperture"].shape == (len(FOCI),)
    told = np.asarray(found.determined)
    assert np.median(np.abs(np.asarray(found.depth) / depth - 1)[told]) < 0.01


@pytest.mark.full
def test_focus_distances_are_found_but_for_a_common_shift():
    """The start's mean inverse focus distance is the true one, so that depths are too."""
    images, depth = two_walls()
    step = (1 / FOCI[0] - 1 / FOCI[-1]) / (len(FOCI) - 1)
    foci = 1 / np.array(FOCI) + step * np.array([0.3, -0.35, 0.25, -0.2])
    start = [ThinLens(0.2, float(1 / focus), 80.0) for focus in foci]
    found = fit.focal_stack(images, start, parameters={"focus_distance"}, **QUICK)
    assert found.success, found.doubt
    reached = np.array([float(lens.focus_distance) for lens in found.lenses])
    np.testing.assert_allclose(reached, FOCI, rtol=0.02)
    told = np.asarray(found.determined)
    assert np.median(np.abs(np.asarray(found.depth) / depth - 1)[told]) < 0.02


@pytest.mark.full
def test_lenses_that_even_images_do_not_tell_are_no_success():
    images = [np.full((24, 24, 1), 0.5)] * len(FOCI)
    found = fit.focal_stack(images, LENSES, parameters={"aperture"}, **QUICK)
    assert np.isinf(found.standard_errors["aperture"]).all()
    assert "do not tell the aperture" in found.doubt


@pytest.mark.full
def test_a_fence_before_a_smooth_wall_is_no_success():
    """Planes take the wall for the bars, two pixels wide: half of the depth is wrong."""
    column = np.mgrid[:48, :48][1]
    bars = (column % 12 < 2)[..., None].astype(float)
    wall = ndimage.gaussian_filter(texture(48, 5, 3), (6, 6, 0), mode="wrap")
    wall = 0.5 + 0.15 * (wall - wall.mean()) / wall.std()
    stripes = texture(48, 100, 3) * [1, 0.3, 0.3] + [0.3, 0, 0]
    lenses = [ThinLens(0.5, focus, 80.0) for focus in FOCI]
    images = [
        through(bars * stripes, 1.5, lens)
        + (1 - through(bars, 1.5, lens)) * through(wall, 4.5, lens)
        for lens in lenses
    ]
    found = fit.focal_stack(images, lenses, min_depth=1.2, max_depth=6.0, **QUICK)
    off = np.abs(np.asarray(found.depth) / np.where(bars[..., 0] > 0, 1.5, 4.5) - 1)
    assert np.mean(off > 0.1) > 0.3
    assert "of what varies" in found.doubt


@pytest.mark.full
def test_the_still_life(monkeypatch):
    """96 x 72 pixels through lenses by many passes."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    example = importlib.util.spec_from_file_location("focal_stack_example", EXAMPLE)
    module = importlib.util.module_from_spec(example)
    example.loader.exec_module(module)
    images, lenses, sharp, depth = module.rendered(96, module.SAMPLES, aperture=0.1)
    found = fit.focal_stack(images, lenses, **module.RANGE, max_steps=8, throw=False)
    assert found.success, found.doubt
    table = module.compared(found, images, lenses, sharp, depth)
    ours = table["fit"]
    told = "median relative error, determined"
    assert ours[told] < 0.05
    assert table["within 1.96 standard errors"] > 0.8
