"""Blend against SciPy's interpolation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxfx import FocusPlanes, ThinLens, dof
from jaxfx.dof._discs import vogel
from jaxfx.dof.blend import taps_kernel
from tests.helpers.forms import first


def test_equals_two_blurs_and_a_lerp():
    rng = np.random.default_rng(0)
    image, depth = rng.random((15, 22, 2)), rng.uniform(1, 9, (15, 22))
    depth[3] = np.inf
    lens, max_coc = FocusPlanes(1.5, 3.0, 8.0, 7.0), 9.0
    offsets = vogel(13) * max_coc / 2 / np.sqrt(2)
    y, x = np.mgrid[:15, :22]

    def blur(channel):
        # The frame is repeated as far as a tap can read, before and after each pass alike.
        taps = [
            ndimage.map_coordinates(channel, [y + dy, x + dx], order=1, mode="nearest")
            for dx, dy in offsets
        ]
        return np.mean(taps, axis=0)

    channels = [blur(blur(image[..., k])) for k in range(2)]
    share = np.asarray(lens.circle_of_confusion(jnp.asarray(depth)))[..., None] / max_coc
    expected = (1 - share) * image + share * np.stack(channels, axis=-1)
    result = dof.blend(image, depth, lens, max_coc=max_coc)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("radius", [0.2, 1.0, 4.3, 12.0])
def test_two_blurs_are_as_wide_as_the_disc(radius):
    kernel = taps_kernel(radius / np.sqrt(2))
    y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
    assert kernel.sum() == pytest.approx(1)
    # Per axis a disc has radius^2 / 4. 13 points have 24/25 of it; bilinear taps add up to 1/4
    # each, twice.
    variance = 2 * (kernel * (x**2 + y**2)).sum() / 2
    assert -0.05 * radius**2 < variance - radius**2 / 4 < 0.5


def test_a_bad_pixel_spoils_what_its_taps_reach():
    rng = np.random.default_rng(0)
    image, depth = rng.random((40, 40, 3)), rng.uniform(1, 9, (40, 40))
    image[20, 20] = np.nan
    depth[:, 25:] = 3.0  # in focus: not touched
    call = jax.jit(lambda *a: dof.blend(*a, ThinLens(0.3, 3.0, 60.0), max_coc=12.0))
    spoiled = np.isnan(call(image, depth)).any(axis=-1)
    y, x = np.nonzero(spoiled)
    assert spoiled[20, 20]
    assert np.hypot(y - 20, x - 20).max() <= 0.71 * 12 + 2
    assert not spoiled[:, 25:].any()


@first("shape", [(1, 5), (4, 1), (2, 3), (9, 8)])
def test_its_transpose_is_that_of_what_it_does(shape):
    """The frame's border, which is repeated as far as taps read, gets back what they read."""
    rng = np.random.default_rng(0)
    image, bar = rng.random((2, *shape, 1))
    depth = rng.uniform(1, 9, shape)
    call = lambda image: dof.blend(image, depth, ThinLens(0.3, 3.0, 60.0), max_coc=5.0)
    columns = jax.vmap(call)(np.eye(image.size).reshape(-1, *image.shape))
    expected = np.tensordot(columns, bar, 3).reshape(image.shape)
    (pulled,) = jax.vjp(call, image)[1](bar)
    np.testing.assert_allclose(pulled, expected, atol=1e-14)
