"""PSNR and SSIM against scikit-image, closed forms and finite differences."""

import inspect
from functools import partial

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from jaxfx import metrics
from tests.helpers.forms import first
from tests.helpers.quick import check_slopes


SKIMAGE = {
    "uniform": {},
    "gaussian": {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False},
}
WINDOWS = sorted(SKIMAGE)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def oracle(image, reference, window, data_range=1.0):
    """scikit-image's SSIM, in float64."""
    return structural_similarity(
        np.asarray(image, np.float64),
        np.asarray(reference, np.float64),
        data_range=data_range,
        channel_axis=-1,
        **SKIMAGE[window],
    )


def noise(rng):
    image = rng.random((24, 31, 3))
    return image, np.clip(image + rng.normal(0, 0.2, image.shape), 0, 1)


def ramp_and_edge(rng):
    y, x = np.mgrid[:33, :40] / 40
    image = np.stack([x, y, x > 0.5], axis=-1)
    return image, np.stack([x, y, x > 0.45], axis=-1) * 0.9


def flat(rng):
    return np.full((20, 20, 1), 0.5), np.full((20, 20, 1), 0.5) + rng.normal(
        0, 1e-3, (20, 20, 1)
    )


def opposite(rng):
    image = rng.random((15, 12, 2))
    return image, 1 - image


def highlights(rng):
    """Linear radiance: a few pixels a thousand times as bright as the rest."""
    image = rng.random((24, 24, 3))
    image[rng.random((24, 24)) < 0.02] *= 1e3
    return image, image * rng.uniform(0.9, 1.1, image.shape)


PAIRS = [noise, ramp_and_edge, flat, opposite, highlights]


@first("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("pair", PAIRS)
def test_psnr_equals_scikit_image(rng, pair, dtype):
    image, reference = (a.astype(dtype) for a in pair(rng))
    value = metrics.psnr(image, reference)
    expected = peak_signal_noise_ratio(
        reference.astype(np.float64), image.astype(np.float64), data_range=1
    )
    assert value.dtype == dtype
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("window", WINDOWS)
@first("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("pair", PAIRS)
def test_ssim_equals_scikit_image(rng, pair, dtype, window):
    image, reference = (a.astype(dtype) for a in pair(rng))
    value = metrics.ssim(image, reference, window=window)
    assert value.dtype == dtype
    tolerance = 1e-5 if dtype == np.float32 else 1e-12
    np.testing.assert_allclose(value, oracle(image, reference, window), rtol=0, atol=tolerance)


@first("window", WINDOWS)
@hyp.given(st.integers(11, 26), st.integers(11, 26), st.integers(1, 4), st.integers(0, 2**32))
@hyp.settings(max_examples=5, deadline=None)
@pytest.mark.full
def test_ssim_of_any_size(window, height, width, channels, seed):
    rng = np.random.default_rng(seed)
    image, reference = rng.random((2, height, width, channels))
    value = metrics.ssim(image, reference, window=window)
    np.testing.assert_allclose(value, oracle(image, reference, window), rtol=0, atol=1e-12)


@pytest.mark.parametrize("window", WINDOWS)
def test_ssim_in_float32_on_a_bright_ground(rng, window):
    """Where a mean of squares less the square of the mean would lose every digit."""
    image = (rng.random((30, 30, 3)) + 1000).astype(np.float32)
    reference = (image + rng.normal(0, 0.2, image.shape)).astype(np.float32)
    value = metrics.ssim(image, reference, window=window)
    np.testing.assert_allclose(value, oracle(image, reference, window), rtol=0, atol=1e-4)


def test_psnr_of_a_constant_error():
    image = np.full((3, 4, 2), 0.25)
    np.testing.assert_allclose(metrics.psnr(image + 0.1, image), 20, rtol=1e-12)
    np.testing.assert_allclose(metrics.psnr(image + 0.1, image, data_range=10), 40, rtol=1e-12)


@pytest.mark.parametrize("data_range", [0.5, 255.0])
@pytest.mark.parametrize("window", WINDOWS)
def test_ssim_data_range(rng, data_range, window):
    image, reference = (a * data_range for a in noise(rng))
    value = metrics.ssim(image, reference, data_range=data_range, window=window)
    expected = oracle(image, reference, window, data_range)
    np.testing.assert_allclose(value, expected, rtol=1e-12)


def test_psnr_mask_leaves_pixels_out(rng):
    image, reference = noise(rng)
    mask = rng.random(image.shape[:2]) < 0.3
    expected = -10 * np.log10(np.mean((image - reference)[mask] ** 2))
    image[~mask] = np.nan
    np.testing.assert_allclose(metrics.psnr(image, reference, mask=mask), expected, rtol=1e-12)
    slope = jax.jit(jax.grad(lambda image: metrics.psnr(image, reference, mask=mask)))
    gradient = np.asarray(slope(image))
    assert np.all(np.isfinite(gradient))
    assert np.all(gradient[~mask] == 0)
    assert np.all(gradient[mask] != 0)


def test_psnr_with_an_empty_mask_that_is_traced_is_nan(rng):
    image, reference = noise(rng)
    psnr = jax.jit(lambda mask: metrics.psnr(image, reference, mask=mask))
    assert np.isnan(psnr(np.zeros(image.shape[:2], bool)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equal_images(rng, dtype):
    image = noise(rng)[0].astype(dtype)
    for function, best in ((metrics.psnr, np.inf), (metrics.ssim, 1)):
        assert float(function(image, image)) == best

        @jax.jit
        def both_modes(image, reference, function=function):
            along = jax.jvp(lambda a: function(a, reference), (image,), (image,))[1]
            return jax.grad(function)(image, reference), along

        gradient, tangent = both_modes(image, image)
        np.testing.assert_allclose(gradient, 0, atol=1e-6 if dtype == np.float32 else 1e-15)
        np.testing.assert_allclose(tangent, 0, atol=1e-6)


CALLS = {
    "psnr": metrics.psnr,
    "psnr of a band": partial(metrics.psnr, mask=np.eye(13, dtype=bool)),
    **{f"ssim {window}": partial(metrics.ssim, window=window) for window in WINDOWS},
}


@first("call", CALLS.values(), 2, ids=CALLS)
def test_gradients(rng, call):
    """In the images and the range, both modes, against finite differences; twice too."""
    image, reference = rng.random((2, 13, 13, 2))
    function = lambda x, y, data_range: call(x, y, data_range=data_range)
    tolerances = {"rtol": 1e-5, "atol": 1e-7, "eps": 1e-5}
    check_slopes(function, (image, reference, 1.3), **tolerances)
    check_slopes(jax.grad(lambda x: function(x, reference, 1.3)), (image,), **tolerances)


@first("call", CALLS.values(), ids=CALLS)
def test_gradient_of_every_pixel(rng, call):
    image, reference = rng.random((2, 13, 13, 1))
    both_modes = jax.jit(lambda *at: (jax.grad(call)(*at), jax.jacfwd(call)(*at)))
    gradient, forward = both_modes(image, reference)
    step = 1e-5
    changes = step * np.eye(image.size).reshape(image.size, *image.shape)
    batch = jax.jit(jax.vmap(lambda change: call(image + change, reference)))
    after, before = np.asarray(batch(changes)), np.asarray(batch(-changes))
    expected = (after - before) / (2 * step)
    np.testing.assert_allclose(np.ravel(gradient), expected, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(forward, gradient, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.full
def test_ssim_gradient_in_float32(rng, window):
    image, reference = noise(rng)
    slope = jax.grad(partial(metrics.ssim, window=window))
    expected = slope(jnp.asarray(image), reference)
    single = slope(jnp.asarray(image, jnp.float32), reference.astype(np.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.full
def test_transforms(rng, call):
    images, references = rng.random((2, 3, 13, 13, 2))
    single = [
        call(image, reference) for image, reference in zip(images, references, strict=True)
    ]

    @jax.jit
    def transformed(images, references):
        slope = jax.grad(call)
        batches = jax.vmap(call)(images, references), jax.vmap(slope)(images, references)
        return *batches, call(images[0], references[0]), slope(images[1], references[1])

    batch, slopes, first, slope = transformed(images, references)
    np.testing.assert_allclose(batch, single, rtol=1e-12)
    np.testing.assert_allclose(first, single[0], rtol=1e-12)
    np.testing.assert_allclose(slopes[1], slope, rtol=1e-10)


def test_types(rng):
    image, reference = noise(rng)
    half = image.astype(np.float16)
    for function in (metrics.psnr, metrics.ssim):
        assert function(half, half).dtype == jnp.float32
        assert function(half, reference.astype(np.float32)).dtype == jnp.float32
        assert function(image.astype(np.float32), reference).dtype == jnp.float64


def test_a_nan_pixel_gives_nan(rng):
    image, reference = noise(rng)
    image[3, 4, 1] = np.nan
    assert np.isnan(metrics.psnr(image, reference))
    assert np.isnan(metrics.ssim(image, reference))


@pytest.mark.parametrize("function", [metrics.psnr, metrics.ssim])
def test_errors_of_both(function):
    bare, name = inspect.unwrap(function), function.__name__
    image = np.zeros((12, 12, 3))
    with pytest.raises(ValueError, match=rf"`{name}\(image\)` must be an image"):
        bare(image[0], image[0])
    with pytest.raises(ValueError, match=rf"`{name}\(reference\)` must be an image"):
        bare(image, image[0])
    with pytest.raises(ValueError, match=rf"`{name}\(reference\)` .* \(12, 12, 3\), got .*1\)"):
        bare(image, image[:, :, :1])
    with pytest.raises(ValueError, match=rf"`{name}\(image\)` must hold floats"):
        bare(image.astype(np.uint8), image)
    with pytest.raises(
        ValueError, match=rf"`{name}\(data_range=...\)` must be positive, got 0"
    ):
        function(image, image, data_range=0)


def test_errors_of_masks():
    image = np.zeros((4, 5, 3))
    bare = inspect.unwrap(metrics.psnr)
    with pytest.raises(
        ValueError, match=r"`psnr\(mask=...\)` must hold booleans of .*\(5, 4\)"
    ):
        bare(image, image, mask=np.ones((5, 4), bool))
    with pytest.raises(ValueError, match=r"`psnr\(mask=...\)` must hold booleans .*float64"):
        bare(image, image, mask=np.ones((4, 5)))
    with pytest.raises(
        ValueError, match=r"`psnr\(mask=...\)` must have a true pixel, got none"
    ):
        metrics.psnr(image, image, mask=np.zeros((4, 5), bool))


@pytest.mark.parametrize(("window", "size"), [("uniform", 7), ("gaussian", 11)])
def test_errors_of_windows(window, size):
    image = np.zeros((size, size, 3))
    assert metrics.ssim(image, image, window=window) == 1
    for small in (image[1:], image[:, 1:]):
        match = rf"`ssim\(image\)` must have at least {size} x {size} pixels"
        with pytest.raises(ValueError, match=match):
            metrics.ssim(small, small, window=window)
    with pytest.raises(ValueError, match=r"`ssim\(window=...\)` must be one of"):
        inspect.unwrap(metrics.ssim)(image, image, window="box")
