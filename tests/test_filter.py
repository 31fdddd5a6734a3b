"""Separable filters of any length, and their transposes, against SciPy and matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxfx import _filter
from tests.helpers.forms import first


def along(size, weights):
    """The matrix of one axis: SciPy's filter of every unit vector."""
    return scipy.ndimage.correlate1d(np.eye(size), weights, axis=0, mode="nearest")


@first(
    ("size", "taps"),
    [((11, 12), 5), ((26, 23), 19), ((7, 20), 9), ((20, 7), 9), ((1, 30), 9), ((9, 9), 9)],
    2,
)
def test_values_and_transpose_are_the_matrices(size, taps):
    rng = np.random.default_rng(taps)
    down, across = (half + half[::-1] for half in rng.random((2, taps)))
    rows, columns = along(size[0], down), along(size[1], across)
    image, bar = rng.random((2, *size, 2))

    @jax.jit
    def both(image, bar):
        call = lambda image: _filter.separable("discrete", image, down, across)
        out, pull = jax.vjp(call, image)
        return out, pull(bar)[0], jax.jvp(call, (image,), (bar,))[1]

    down, across = jnp.asarray(down), jnp.asarray(across)
    out, back, dot = both(image, bar)
    product = lambda rows, image, columns: np.einsum("yj,jic,xi->yxc", rows, image, columns)
    np.testing.assert_allclose(out, product(rows, image, columns), rtol=1e-12)
    np.testing.assert_allclose(dot, product(rows, bar, columns), rtol=1e-12)
    np.testing.assert_allclose(back, product(rows.T, bar, columns.T), rtol=1e-12)


@pytest.mark.parametrize("sampling", ["discrete", "linear"])
def test_many_taps(sampling):
    image = np.random.default_rng(0).random((20, 30, 3))
    weights = np.exp(-(np.linspace(-2, 2, 21) ** 2))
    expected = scipy.ndimage.correlate1d(image, weights, 0, mode="nearest")
    expected = scipy.ndimage.correlate1d(expected, weights, 1, mode="nearest")
    blur = jax.jit(lambda image, weights: _filter.separable(sampling, image, weights, weights))
    np.testing.assert_allclose(blur(image, weights), expected, rtol=1e-13)
