"""Running extremes and unions, against a loop over windows."""

import jax
import numpy as np

from jaxfx.shadow._edges import extremes, unions
from tests.helpers.forms import first


@first(
    ("shape", "size"),
    [((3, 3), 3), ((7, 9), 7), ((20, 23), 1), ((20, 23), 3), ((25, 23), 21)],
    2,
)
def test_running_extremes(shape, size):
    image = np.random.default_rng(0).normal(size=shape)
    smallest, largest = map(np.asarray, jax.jit(extremes, static_argnums=1)(image, size))
    assert smallest.shape == largest.shape == tuple(side - size + 1 for side in shape)
    for j, i in np.ndindex(*smallest.shape):
        window = image[j : j + size, i : i + size]
        assert (smallest[j, i], largest[j, i]) == (window.min(), window.max())
    bits = (1 << (image > 0)).astype(np.uint8)
    seen = (smallest <= 0) * 1 + (largest > 0) * 2
    np.testing.assert_array_equal(jax.jit(unions, static_argnums=1)(bits, size), seen)
