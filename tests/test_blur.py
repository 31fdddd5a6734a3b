"""Blur against NumPy's plain sums and SciPy, the paper's numbers, and where it fails."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxfx import blur
from tests.helpers.forms import first


# Rakos 2010: row 12 of Pascal's triangle without its outer two, and the linear samples of it.
PAPER = [0.2270270270, 0.1945945946, 0.1216216216, 0.0540540541, 0.0162162162]
PAPER_LINEAR = {
    0.0: 0.2270270270,
    1.3846153846: 0.3162162162,
    3.2307692308: 0.0702702703,
}


def random_image(height, width, channels=3, dtype=np.float64):
    rng = np.random.default_rng([height, width, channels])
    return rng.random((height, width, channels)).astype(dtype)


def by_hand(image, weights):
    """The weighted mean of every neighbourhood, tap by tap, the border's pixels repeated."""
    height, width, _ = image.shape
    half = len(weights) // 2
    out = np.zeros(image.shape)
    for j, i in np.ndindex(height, width):
        for dj, di in np.ndindex(len(weights), len(weights)):
            y = min(max(j + dj - half, 0), height - 1)
            x = min(max(i + di - half, 0), width - 1)
            out[j, i] += weights[dj] * weights[di] * image[y, x]
    return out


def by_scipy(image, weights):
    columns = scipy.ndimage.correlate1d(image, weights, axis=0, mode="nearest")
    return scipy.ndimage.correlate1d(columns, weights, axis=1, mode="nearest")


def test_weights_and_reads_are_the_papers():
    weights = np.asarray(blur.binomial_weights(9, row=12))
    np.testing.assert_allclose(weights, PAPER[:0:-1] + PAPER, atol=5e-11)
    np.testing.assert_allclose(weights * 4070, [66, 220, 495, 792, 924, 792, 495, 220, 66])
    offsets, shares = blur.linear_taps(weights)
    expected = sorted({s * o: w for o, w in PAPER_LINEAR.items() for s in (-1, 1)}.items())
    np.testing.assert_allclose(np.stack([offsets, shares], 1), expected, atol=5e-11)


def test_a_whole_row_is_not_dropped():
    nine, four = (np.asarray(blur.binomial_weights(n, row=n - 1)) for n in (9, 4))
    np.testing.assert_allclose(nine * 256, [1, 8, 28, 56, 70, 56, 28, 8, 1])
    np.testing.assert_allclose(four * 8, [1, 3, 3, 1])


@pytest.mark.parametrize("taps", range(1, 12))
def test_linear_reads_are_half_as_many_for_the_same_sum(taps):
    weights = np.random.default_rng(taps).random(taps)
    signal = np.random.default_rng(0).random(taps)
    offsets, shares = map(np.asarray, blur.linear_taps(weights))
    assert len(offsets) == len(shares) == (taps + 1) // 2
    assert (np.diff(offsets) > 0).all()
    positions = np.arange(taps) - (taps - 1) / 2
    read = np.interp(offsets, positions, signal)
    np.testing.assert_allclose(np.sum(shares * read), np.sum(weights * signal), rtol=1e-13)
    symmetric = np.asarray(blur.linear_taps(weights + weights[::-1])[0])
    np.testing.assert_allclose(symmetric, -symmetric[::-1], atol=1e-14)


@pytest.mark.parametrize("sampling", ["discrete", "linear"])
@pytest.mark.parametrize(
    ("size", "taps"),
    [((13, 11), 9), ((2, 9), 9), ((1, 23), 9), ((9, 8), 9), ((1, 1), 9), ((6, 7), 3)],
)
def test_the_sum_by_hand(size, taps, sampling):
    image = random_image(*size)
    weights = np.asarray(blur.binomial_weights(taps, row=taps + 3))
    out = blur.gaussian(image, taps=taps, sampling=sampling)
    np.testing.assert_allclose(out, by_hand(image, weights), rtol=1e-13)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, jnp.bfloat16])
def test_scipy_over_several_passes(dtype):
    image = random_image(31, 27).astype(dtype)
    weights = np.asarray(blur.binomial_weights(7, row=6))
    expected = image.astype(np.float64)
    for _ in range(3):
        expected = by_scipy(expected, weights)
    out = blur.gaussian(image, taps=7, passes=3, row=6)
    assert out.dtype == dtype
    np.testing.assert_allclose(
        np.asarray(out).astype(float), expected, rtol=4 * float(jnp.finfo(dtype).eps)
    )


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_any_number_of_channels(channels):
    image = random_image(12, 10, channels)
    out = blur.gaussian(image, taps=5)
    weights = np.asarray(blur.binomial_weights(5, row=8))
    np.testing.assert_allclose(out, by_scipy(image, weights), rtol=1e-13)


def test_both_samplings_agree_to_rounding():
    image = random_image(64, 48, dtype=np.float32)
    discrete, linear = (
        np.asarray(blur.gaussian(image, passes=9, sampling=sampling))
        for sampling in ("discrete", "linear")
    )
    # Nine passes of two sums each, some rounding in every one.
    assert np.abs(discrete - linear).max() < 18 * 2e-7


def test_dividing_by_the_whole_row_would_darken():
    ones = np.ones((16, 16, 1))
    kept = np.array([math.comb(12, i) for i in range(2, 11)])
    darkened = ones
    for passes in range(1, 10):
        darkened = by_scipy(darkened, kept / 4096)
        # 1.3 % darker with each pass, a tenth after nine.
        np.testing.assert_allclose(darkened, (4070 / 4096) ** (2 * passes))
    assert darkened.max() < 0.892
    np.testing.assert_allclose(blur.gaussian(ones, passes=9), 1, rtol=1e-14)


def test_four_passes_of_9_reach_as_far_as_33_taps():
    point = np.zeros((41, 41, 1))
    point[20, 20] = 1
    out = np.asarray(blur.gaussian(point, passes=4))[..., 0]
    rows, columns = np.nonzero(out)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (4, 36, 4, 36)
    offset = np.arange(41) - 20
    weights = np.asarray(blur.binomial_weights(9, row=12))
    one = np.sum(weights * (np.arange(9) - 4) ** 2)
    np.testing.assert_allclose(np.sum(out.sum(axis=1) * offset**2), 4 * one)


@pytest.mark.parametrize("passes", [1, 3])
def test_sigma_is_that_of_the_whole_blur(passes):
    point = np.zeros((1, 81, 1))
    point[0, 40] = 1
    offset = np.arange(81) - 40
    for sigma in (1.2, 1.7, 2.5):
        out = np.asarray(blur.gaussian(point, taps=25, passes=passes, sigma=sigma)).ravel()
        np.testing.assert_allclose(np.sum(out * offset**2) ** 0.5, sigma, rtol=3e-3)


def test_scipys_gaussian():
    image = random_image(24, 26, 1)
    out = blur.gaussian(image, taps=13, sigma=1.5)
    expected = scipy.ndimage.gaussian_filter(image[..., 0], 1.5, mode="nearest", radius=6)
    np.testing.assert_allclose(np.asarray(out)[..., 0], expected, rtol=1e-13)


@first("passes", [1, 4])
@first("sigma", [3.0, 10.0, np.float32(10), jnp.asarray(10.0)])
def test_a_sigma_alone_sets_the_taps(sigma, passes):
    """As wide as asked for, but for what lies beyond 4 standard deviations."""
    expected = float(sigma)
    assert spread_of(sigma, None, passes, reach=80) == pytest.approx(expected, rel=2e-3)
    # Inside of another trace, too, where it is closed over.
    image = random_image(9, 12)
    compiled = jax.jit(lambda image: blur.gaussian(image, sigma=sigma, passes=passes))(image)
    expected_image = blur.gaussian(image, sigma=sigma, passes=passes)
    np.testing.assert_allclose(compiled, expected_image, rtol=1e-6)
    taps = 2 * math.ceil(4 * expected / passes**0.5) + 1
    given = blur.gaussian(image, sigma=sigma, passes=passes, taps=taps)
    np.testing.assert_array_equal(expected_image, given)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 3)])
def test_a_sigma_of_0_alone_is_the_identity(size):
    image = random_image(*size)

    @jax.jit
    def blurred_and_pulled(image):
        out, pull = jax.vjp(lambda image: blur.gaussian(image, sigma=0.0), image)
        return out, *pull(image)

    out, pulled = blurred_and_pulled(image)
    np.testing.assert_array_equal(out, image)
    np.testing.assert_array_equal(pulled, image)


def spread_of(sigma, taps, passes=1, reach=None):
    reach = passes * (taps // 2) if reach is None else reach
    point = np.zeros((1, 2 * reach + 1, 1))
    point[0, reach] = 1
    out = blur.gaussian(point, taps=taps, passes=passes, sigma=sigma)
    return (
        float(np.sum(np.asarray(out).ravel() * (np.arange(2 * reach + 1) - reach) ** 2)) ** 0.5
    )


def test_a_sigma_that_the_taps_do_not_hold_falls_short_as_documented():
    """Of 9 taps: 2 % at a sigma of 1.5, 13 % at 2, 40 % at 4; and no more than a box."""
    for passes in (1, 4):
        n = passes**0.5
        assert spread_of(9 / 5 * n * 0.75, 9, passes) == pytest.approx(
            9 / 5 * n * 0.75, rel=0.02
        )
        assert 0.9 < spread_of(9 / 5 * n, 9, passes) / (9 / 5 * n) < 0.96
        assert spread_of(4 * n, 9, passes) / (4 * n) < 0.62
        assert spread_of(1e3, 9, passes) == pytest.approx((passes * 80 / 12) ** 0.5, rel=1e-4)


@first("sampling", ["discrete", "linear"])
def test_sigma_0_is_the_identity_with_a_gradient_of_0(sampling):
    """In float32; in float64, in `tests/stability`."""
    image = random_image(12, 14, dtype=np.float32)

    @jax.jit
    def both(sigma):
        blurred = lambda sigma: blur.gaussian(image, taps=9, sampling=sampling, sigma=sigma)
        return jax.jvp(blurred, (sigma,), (jnp.ones_like(sigma),))

    for sigma in (0.0, 1e-30, 1e-3, 0.02):
        out, slope = both(np.asarray(sigma))
        np.testing.assert_array_equal(out, image)
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.full
def test_gradients_in_sigma_and_the_image_are_differences():
    image, bar = (jnp.asarray(random_image(14, 12, c)[..., :2]) for c in (2, 3))

    @jax.jit
    def loss(image, sigma):
        return jnp.sum(bar * blur.gaussian(image, taps=9, passes=2, sigma=sigma) ** 2)

    by_image, by_sigma = jax.jit(jax.grad(loss, argnums=(0, 1)))(image, jnp.asarray(1.3))
    difference = (loss(image, 1.3 + 1e-5) - loss(image, 1.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(by_sigma, difference, rtol=1e-8)
    for pixel in ((0, 0, 0), (13, 11, 1), (0, 6, 1), (5, 2, 0), (7, 6, 1)):
        move = jnp.zeros_like(image).at[pixel].set(1e-5)
        difference = (loss(image + move, 1.3) - loss(image - move, 1.3)) / 2e-5
        np.testing.assert_allclose(by_image[pixel], difference, rtol=1e-8)


@pytest.mark.parametrize("sampling", ["discrete", "linear"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("pixel", [(10, 12), (0, 0), (3, 25), (20, 2)])
def test_a_bad_pixel_spoils_what_its_taps_reach(pixel, value, sampling):
    image = random_image(21, 26)
    image[*pixel, 1] = value
    out = np.asarray(blur.gaussian(image, sampling=sampling))
    y, x = np.mgrid[:21, :26]
    near = (abs(y - pixel[0]) <= 4) & (abs(x - pixel[1]) <= 4)
    np.testing.assert_array_equal(~np.isfinite(out[..., 1]), near)
    assert np.isfinite(out[..., ::2]).all()


@pytest.mark.parametrize("sampling", ["discrete", "linear"])
def test_a_bad_first_pixel_spoils_no_more_where_there_are_many_taps(sampling):
    """Many taps are added in groups, which read the first pixel."""
    image = random_image(30, 34)
    clean = np.asarray(blur.gaussian(image, sampling=sampling, sigma=3.0))
    image[0, 0] = np.nan
    out = np.asarray(blur.gaussian(image, sampling=sampling, sigma=3.0))
    is_near = np.zeros((30, 34, 1), bool)
    is_near[:13, :13] = True
    np.testing.assert_allclose(out, np.where(is_near, np.nan, clean), rtol=1e-12)


def test_a_constant_stays():
    for sigma in (None, 2.0):
        out = blur.gaussian(np.full((17, 19, 3), 0.3, np.float32), passes=4, sigma=sigma)
        np.testing.assert_allclose(out, 0.3, rtol=1e-6)


def test_bytes_round_where_floats_do_not():
    """Rounded to 256 steps after each of 9 passes, a faint slope turns to steps."""
    slope = np.tile(np.linspace(0.10, 0.12, 64)[None, :, None], (8, 1, 1))
    exact = np.asarray(blur.gaussian(slope, passes=9))
    stepped = slope
    for _ in range(9):
        stepped = np.round(255 * np.asarray(blur.gaussian(stepped))) / 255
    assert np.abs(stepped - exact).max() > 0.4 / 255
    single = np.asarray(blur.gaussian(slope.astype(np.float32), passes=9))
    assert np.abs(single - exact).max() < 1e-7


@pytest.mark.parametrize("taps", [2, 4, 6])
@pytest.mark.parametrize("size", [(8, 10), (7, 5), (1, 1), (1, 4)])
def test_half_the_size(size, taps):
    image = random_image(*size)
    weights = np.asarray(blur.binomial_weights(taps, row=taps - 1))
    rows, columns = (
        np.arange(2 * -(-n // 2)).reshape(-1, 2)[:, :1] + np.arange(taps) - taps // 2 + 1
        for n in size
    )
    rows, columns = rows.clip(0, size[0] - 1), columns.clip(0, size[1] - 1)
    patches = image[rows[:, None, :, None], columns[None, :, None, :]]
    expected = np.einsum("hwijc,i,j->hwc", patches, weights, weights)
    np.testing.assert_allclose(blur.downsample(image, taps=taps), expected, rtol=1e-13)


def test_twice_halved_is_the_mean_of_16():
    image = random_image(12, 8)
    quarter = blur.downsample(blur.downsample(image))
    np.testing.assert_allclose(quarter, image.reshape(3, 4, 2, 4, 3).mean(axis=(1, 3)))


def test_faults_are_named():
    image = random_image(4, 4)
    gaussian = inspect.unwrap(blur.gaussian)
    for options, message in [
        ({"taps": 4}, r"`gaussian\(taps=...\)` must be an odd positive integer, got 4"),
        ({"taps": 9.0}, r"`gaussian\(taps=...\)` must be an odd positive integer, got 9.0"),
        ({"passes": 0}, r"`gaussian\(passes=...\)` must be a positive integer, got 0"),
        ({"sampling": "cubic"}, r"`gaussian\(sampling=...\)` must be one of .* got 'cubic'"),
        ({"sigma": -1.0}, r"`gaussian\(sigma=...\)` must be 0 or positive, got -1.0"),
        (
            {"sigma": math.inf},
            r"`gaussian\(sigma=...\)` must be finite without .* got inf",
        ),
        ({"sigma": 1.0, "row": 12}, r"`gaussian\(row=...\)` must be left out .* got 12"),
        ({"row": 9}, r"`gaussian\(row=...\)` must be 8, 10, 12 .* got 9"),
    ]:
        with pytest.raises(ValueError, match=message):
            gaussian(image, **options)
    with pytest.raises(ValueError, match=r"`gaussian\(taps=...\)` must be given under `jit`"):
        jax.jit(lambda sigma: gaussian(image, sigma=sigma))(2.0)
    with pytest.raises(ValueError, match=r"`gaussian\(image\)` must be an image of shape"):
        gaussian(image[0])
    with pytest.raises(ValueError, match=r"`downsample\(taps=...\)` must be even .* got 3"):
        inspect.unwrap(blur.downsample)(image, taps=3)
    with pytest.raises(ValueError, match=r"`binomial_weights\(row=...\)` must be 8, 10, .* 7"):
        inspect.unwrap(blur.binomial_weights)(9, row=7)
    with pytest.raises(ValueError, match=r"`binomial_weights\(taps=...\)` must be a positive"):
        inspect.unwrap(blur.binomial_weights)(0, row=7)
    with pytest.raises(ValueError, match=r"`linear_taps\(tap_weights\)` must be 0 or positive"):
        inspect.unwrap(blur.linear_taps)(np.array([1.0, -1.0]))
    with pytest.raises(ValueError, match=r"`linear_taps\(tap_weights\)` must be a vector"):
        inspect.unwrap(blur.linear_taps)(np.ones((2, 2)))
