"""Depth and image from focal stacks: walls whose circles of confusion are known, and rooms."""

import importlib.util
import inspect
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.special import j1

from jaxfx import ThinLens, dof, fit
from jaxfx.fit._stack_planes import disc
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
    np.testing.assert_allclose(disc(jnp.asarray(cycles)), expected, atol=1e-12)
    assert float(disc(jnp.zeros(1))[0]) == pytest.approx(1)


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


@pytest.mark.full
def test_the_still_life(monkeypatch):
    """96 x 72 pixels through lenses by many passes."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    example = importlib.util.spec_from_file_location("focal_stack_example", EXAMPLE)
    module = importlib.util.module_from_spec(example)
    example.loader.exec_module(module)
    images, lenses, sharp, depth = module.rendered(96, module.SAMPLES)
    found = fit.focal_stack(images, lenses, **module.RANGE, max_steps=8, throw=False)
    assert found.success, found.doubt
    table = module.compared(found, images, lenses, sharp, depth)
    ours = table["fit"]
    told = "median relative error, determined"
    assert ours[told] < 0.05
    assert table["within 1.96 standard errors"] > 0.8
