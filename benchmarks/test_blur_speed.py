"""Blur against OpenCV and SciPy, in one run: 1024 x 1024 x 3 float32, 9 taps each way.

`pytest --benchmark-only benchmarks` prints each group with its medians, its spread and
the ratios to its quickest. The floor: an image of 12.6 MB is read once and written once by
each of two passes, 50 MB in all; OpenCV keeps some rows in its cache and moves half of that.
"""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from benchmarks.turns import in_turns
from jaxfx import _sampling, blur


IMAGE = np.random.default_rng(0).random((1024, 1024, 3), np.float32)
WEIGHTS = np.asarray(blur.binomial_weights(9, row=12), np.float32)


def opencv():
    reason = "OpenCV, the strongest peer, is not installed: pip install opencv-python-headless"
    cv2 = pytest.importorskip("cv2", reason=reason)
    cv2.setNumThreads(len(os.sched_getaffinity(0)))
    options = {"borderType": cv2.BORDER_REPLICATE}
    return lambda: cv2.sepFilter2D(IMAGE, -1, WEIGHTS, WEIGHTS, **options)


def scipy_filters():
    def one(image, axis):
        return scipy.ndimage.correlate1d(image, WEIGHTS, axis, mode="nearest")

    return lambda: one(one(IMAGE, 0), 1)


def by_texture(image):
    """Linear sampling as a texture unit does it: a bilinear read at every offset."""
    offsets, weights = blur.linear_taps(WEIGHTS)
    centers = _sampling.pixel_centers(*image.shape[:2], image.dtype)
    for axis in (1, 0):
        reads = zip(offsets, weights, strict=True)
        image = sum(
            w * _sampling.bilinear(image, centers.at[..., axis].add(o)) for o, w in reads
        )
    return image


def compiled(function):
    call, image = jax.jit(function), jnp.asarray(IMAGE)
    return lambda: jax.block_until_ready(call(image))


PEERS = {
    "OpenCV": opencv,
    "SciPy": scipy_filters,
    "discrete": lambda: compiled(blur.gaussian),
    "linear": lambda: compiled(lambda image: blur.gaussian(image, sampling="linear")),
    "sigma": lambda: compiled(lambda image: blur.gaussian(image, taps=9, sigma=1.7)),
}


@pytest.mark.parametrize("peer", PEERS)
def test_one_pass_of_9_taps(benchmark, peer):
    benchmark.group = "one pass of 9 taps each way"
    function = PEERS[peer]()
    expected = PEERS["discrete"]()()
    if peer != "sigma":
        np.testing.assert_allclose(function(), expected, atol=1e-6)
    benchmark.pedantic(function, rounds=31, warmup_rounds=3)


@pytest.mark.parametrize(("peer", "calls"), [("OpenCV", 40), ("SciPy", 1)])
def test_ratio(benchmark, peer, calls):
    """Ours and a peer's: the ratio of the medians, ours to theirs, is kept with the run."""
    benchmark.group = f"ours, in turns with {peer}, {calls} calls"
    functions = {peer: PEERS[peer](), "ours": PEERS["discrete"]()}
    median = in_turns(benchmark, functions, calls=calls)
    benchmark.extra_info["ratio"] = median["ours"] / median[peer]


@pytest.mark.parametrize("form", ["one of 33", "four of 9", "four of 9, bilinear reads"])
def test_33_taps(benchmark, form):
    benchmark.group = "33 taps each way"
    function = {
        "one of 33": lambda image: blur.gaussian(image, taps=33),
        "four of 9": lambda image: blur.gaussian(image, passes=4),
        "four of 9, bilinear reads": lambda image: jax.lax.fori_loop(
            0, 4, lambda _, image: by_texture(image), image
        ),
    }[form]
    benchmark.pedantic(compiled(function), rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("mode", ["forward", "jvp", "grad"])
def test_derivatives(benchmark, mode):
    benchmark.group = "derivatives in the image and sigma"
    loss = lambda image, sigma: jnp.sum(blur.gaussian(image, taps=9, sigma=sigma) ** 2)
    sigma = jnp.float32(1.7)
    function = {
        "forward": lambda image: loss(image, sigma),
        "jvp": lambda image: jax.jvp(loss, (image, sigma), (image[::-1], sigma)),
        "grad": lambda image: jax.grad(loss, argnums=(0, 1))(image, sigma),
    }[mode]
    benchmark.pedantic(compiled(function), rounds=7, warmup_rounds=1)


@pytest.mark.parametrize("taps", [2, 4])
def test_half_the_size(benchmark, taps):
    benchmark.group = "half the size"
    benchmark.pedantic(
        compiled(lambda image: blur.downsample(image, taps=taps)), rounds=9, warmup_rounds=1
    )
