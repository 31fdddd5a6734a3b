"""How sure a fit of lights is: coverage where shadows are lacking, doubt where it is due."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import DirectionalLight, PointLight, fit, relight
from jaxfx.fit import _robust
from tests.cases import lit
from tests.cases.lit import CAMERA, SIZE, cache


WHITE = np.ones(3)


def fitted_to(image, start, **options):
    return fit.lights(image, cache(), CAMERA, start, throw=False, **options)


def grainy(lights, seed=0, noise=0.01):
    image = np.asarray(relight.render(cache(), CAMERA, lights))
    size = noise * np.sqrt(np.mean(image**2))
    return image + size * np.random.default_rng(seed).normal(size=image.shape)


def coverage(count, **scene):
    """The share of each parameter that lies within 1.96 stated errors of the truth."""
    within = []
    for seed in range(count):
        image, truth, start = lit.problem(seed, **scene)
        found = lit.misses(fitted_to(image, start), truth).values()
        pairs = [np.concatenate(each) for each in zip(*found, strict=True)]
        within.append(np.abs(pairs[0]) < 1.96 * pairs[1])
    return np.mean(within, axis=0)


@pytest.mark.full
def test_stated_errors_hold_where_the_model_lacks_shadows():
    """A sun and a lamp, each before three spheres: colours, direction and position."""
    covered = coverage(100)
    assert covered.shape == (10,) and covered.min() >= 0.85


@pytest.mark.full
def test_stated_errors_hold_for_cones():
    covered = coverage(50, kinds=(lit.AmbientLight, lit.SpotLight), spheres=2)
    assert covered.shape == (12,) and covered.min() >= 0.85


def test_shadows_that_the_model_lacks_have_no_say():
    image, truth, start = lit.problem(0)
    clean = np.asarray(relight.render(cache(), CAMERA, truth))
    shaded = np.linalg.norm(image - clean, axis=-1) > 0.15 * np.sqrt(np.mean(image**2))
    assert 0.03 < shaded.mean() < 0.4
    robust, plain = (fitted_to(image, start, loss=each) for each in ("robust", "squares"))
    assert robust.success and np.asarray(robust.weights)[shaded].max() == 0
    worst = [
        max(np.abs(miss).max() for miss, _ in lit.misses(each, truth).values())
        for each in (robust, plain)
    ]
    assert worst[0] < 0.1 * worst[1]


@pytest.mark.full
def test_what_is_left_out_has_no_say():
    """And the weights that are given multiply those that are found."""
    image, _, start = lit.problem(1, spheres=0)
    out = np.zeros((SIZE, SIZE), bool)
    out[3:14, 5:20] = True
    weights = np.where(out, 0, 1)
    one, other = (
        fitted_to(np.where(out[..., None], fill, image), start, weights=weights)
        for fill in (0.0, 50.0)
    )
    for a, b in zip(jax.tree.leaves(one.lights), jax.tree.leaves(other.lights), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (np.asarray(one.weights)[out] == 0).all() and one.success
    twice = fitted_to(image, start, weights=2 * np.ones((SIZE, SIZE)))
    plain = fitted_to(image, start)
    np.testing.assert_allclose(twice.weights, 2 * plain.weights, atol=1e-3)
    np.testing.assert_allclose(twice.share, plain.share, rtol=1e-3)


@pytest.mark.full
def test_the_weights_are_those_of_the_residuals_in_the_end():
    """By a plain loop over pixels: own residuals and sums of 5 x 5, each over its median."""
    image, _, start = lit.problem(2)
    found = fitted_to(image, start)
    residual = np.asarray(found.image) - image
    own, wide = np.empty((2, SIZE, SIZE))
    for i in range(SIZE):
        for j in range(SIZE):
            near = residual[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3].reshape(-1, 3)
            own[i, j] = np.linalg.norm(residual[i, j])
            wide[i, j] = np.linalg.norm(near.sum(axis=0)) / np.sqrt(len(near))
    # 1.538 is the median length of three Gaussians.
    share = [length / (5.5 * np.median(length) / 1.538) for length in (own, wide)]
    expected = np.prod([np.maximum(1 - each**2, 0) ** 2 for each in share], axis=0)
    np.testing.assert_allclose(found.weights, expected, atol=0.02)


def test_noise_is_told_by_medians_and_costs_a_tenth():
    """Of Gaussian noise: its size, whatever a third of the pixels show; the loss' slope by
    differences of the weighted residual, moved everywhere."""
    rng = np.random.default_rng(0)
    noise, ones = jnp.asarray(rng.normal(size=(200, 200, 3))), jnp.ones((200, 200))
    length = _robust.lengths(noise, ones)
    told = _robust.noise_of(length, ones)
    np.testing.assert_allclose(told, 1, rtol=0.03)
    weight = lambda x: _robust.biweight(_robust.lengths(x, ones), told)
    pull = lambda x: jnp.mean(weight(x)[..., None] * x)
    slope = (pull(noise + 1e-4) - pull(noise - 1e-4)) / 2e-4
    expected = slope / jnp.mean(weight(noise))
    flat = _robust.flatness(length, told, ones)
    np.testing.assert_allclose(flat, expected, rtol=0.03)
    assert 0.6 < flat < 0.9


@pytest.mark.full
@pytest.mark.parametrize("about", ["mirrored", "noise", "another scene"])
def test_a_picture_of_something_else_is_doubted(about):
    rng = np.random.default_rng(0)
    image, _, start = lit.problem(3)
    other = jax.image.resize(rng.uniform(size=(5, 5, 3)), image.shape, "cubic")
    pictures = {"mirrored": image[:, ::-1], "noise": rng.uniform(size=image.shape)}
    found = fitted_to(pictures.get(about, other), start)
    assert not found.success and "of the contrast is explained" in found.doubt
    with pytest.raises(RuntimeError, match=r"found no lights in \d+ steps.*contrast"):
        fit.lights(pictures.get(about, other), cache(), CAMERA, start)


@pytest.mark.full
def test_how_far_a_distant_lamp_is_remains_untold():
    far = 2000.0
    truth = PointLight([0.3 * far, 0.2 * far, -far], far**2 * np.array([1.0, 0.8, 0.6]))
    start = PointLight([0.25 * far, 0.25 * far, -0.7 * far], WHITE)
    for noise in (0.0, 0.01):
        found = fitted_to(grainy([truth], noise=noise), [start])
        assert not found.success and (0, "position") in found.untold
        assert "position of light 0" in found.doubt
        error = np.linalg.norm(found.standard_errors[0]["position"])
        assert error > 0.2 * np.linalg.norm(found.lights[0].position)


@pytest.mark.full
@pytest.mark.parametrize("gap", [0.0, 0.01])
def test_suns_that_are_nearly_one_are_doubted(gap):
    """Their sum is seen, their shares are not; suns that are apart are told."""
    start = [DirectionalLight([x, 0.2, 1.0], WHITE) for x in (0.2, 0.4)]
    for seed in range(6):
        truth = [DirectionalLight([0.3, y, 1.0], WHITE) for y in (0.2, 0.2 + gap)]
        found = fitted_to(grainy(truth, seed), start)
        assert found.indistinct == ((0, 1),) and found.explained > 0.99
        assert found.doubt == "The image can't tell apart lights 0 and 1."
        assert all(np.isinf(errors["color"]).all() for errors in found.standard_errors)
    truth = [DirectionalLight([x, 0.2, 1.0], WHITE) for x in (0.0, 0.6)]
    assert fitted_to(grainy(truth), start).success


@pytest.mark.full
def test_a_few_pixels_are_not_enough():
    image, _, start = lit.problem(4, spheres=0)
    weights = np.zeros((SIZE, SIZE))
    weights[10:14, 10:14] = 1
    found = fitted_to(image, start, weights=weights)
    assert not found.success
    assert all(np.isinf(v).all() for each in found.standard_errors for v in each.values())
