"""The sprite of a pixel: its rows' area, and what it covers in all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.dof._sprites import coverage, row_half_width, segment_integral


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_polynomial_is_the_arc(dtype):
    radius = jnp.asarray([0.5, 0.7, 1.0, 3.3, 17.0, 64.0], dtype)
    tolerance = 1e-6 if dtype == jnp.float32 else 1e-11
    for row in range(5):
        upper, lower = (
            segment_integral(radius, jnp.asarray(abs(row + edge), dtype), True)
            for edge in (0.5, -0.5)
        )
        sign = -1 if row == 0 else 1  # odd in the height
        width, slope = (x - sign * y for x, y in zip(upper, lower, strict=True))
        expected = row_half_width(radius, row)
        slopes = jax.vmap(jax.grad(lambda r, row=row: row_half_width(r, row)))(radius)
        np.testing.assert_allclose(width, expected, atol=tolerance * 64**2)
        np.testing.assert_allclose(slope, slopes, atol=tolerance * 64)


@pytest.mark.parametrize("radius", [0.5, 0.8, 2.0, 7.3])
def test_what_a_disc_covers_is_as_much_as_in_counted_points(radius):
    reach, fine = int(radius + 1), 64
    rows = jnp.arange(-reach, reach + 1)
    width = jax.vmap(lambda row: row_half_width(jnp.asarray(radius), row))(rows)
    cover = jax.vmap(lambda column: coverage(width, column))(rows).T
    np.testing.assert_allclose(jnp.sum(2 * width), np.pi * radius**2, rtol=1e-12)
    side = (2 * reach + 1) * fine
    y, x = (np.mgrid[:side, :side] + 0.5) / fine - reach - 0.5
    inside = (x * x + y * y < radius * radius).reshape(2 * reach + 1, fine, -1, fine)
    # A row is one rectangle as wide as its area: equal in all, not pixel by pixel.
    counted = inside.mean(axis=(1, 3)).sum(axis=1)
    np.testing.assert_allclose(np.asarray(cover).sum(axis=1), counted, atol=2e-2)
