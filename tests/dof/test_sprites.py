"""The sprite of a pixel: its rows' area, and what it covers in all."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof.sprites import coverage, row_half_width, segment_integral
from tests.helpers.forms import first


@first("dtype", [jnp.float32, jnp.float64])
def test_the_polynomial_is_the_arc(dtype):
    radius = np.array([0.5, 0.7, 1.0, 3.3, 17.0, 64.0], dtype)
    tolerance = 1e-6 if dtype == jnp.float32 else 1e-11

    @jax.jit
    def at(radius, row):
        arcs = jax.vmap(jax.value_and_grad(row_half_width), (0, None))(radius, row)
        return *(segment_integral(radius, jnp.abs(row + h), True) for h in (0.5, -0.5)), arcs

    for row in range(5):
        upper, lower, (expected, slopes) = jax.device_get(at(radius, np.asarray(row, dtype)))
        sign = -1 if row == 0 else 1  # odd in the height
        width, slope = (x - sign * y for x, y in zip(upper, lower, strict=True))
        np.testing.assert_allclose(width, expected, atol=tolerance * 64**2)
        np.testing.assert_allclose(slope, slopes, atol=tolerance * 64)


@first("radius", [0.5, 0.8, 2.0, 7.3], 2)
def test_what_a_disc_covers_is_as_much_as_in_counted_points(radius):
    reach, fine = int(radius + 1), 64

    @jax.jit
    def covered(rows):
        width = jax.vmap(lambda row: row_half_width(jnp.asarray(radius), row))(rows)
        return width, jax.vmap(lambda column: coverage(width, column))(rows).T

    width, cover = map(np.asarray, covered(np.arange(-reach, reach + 1)))
    np.testing.assert_allclose(np.sum(2 * width), np.pi * radius**2, rtol=1e-12)
    side = (2 * reach + 1) * fine
    y, x = (np.mgrid[:side, :side] + 0.5) / fine - reach - 0.5
    inside = (x * x + y * y < radius * radius).reshape(2 * reach + 1, fine, -1, fine)
    # A row is one rectangle as wide as its area: equal in all, not pixel by pixel.
    counted = inside.mean(axis=(1, 3)).sum(axis=1)
    np.testing.assert_allclose(cover.sum(axis=1), counted, atol=2e-2)


@first("name", ["scatter", "layered", "depth_sorted"])
@first(("aperture", "is_moving"), [(0.004, False), (0.1, True), (3.0, False)])
@pytest.mark.full
def test_a_circle_below_a_pixel_or_above_max_coc_moves_nothing(name, aperture, is_moving):
    """Circles of 0.1 pixels at the most, of 0.6 to 3, and of 17 at the least."""
    rng = np.random.default_rng(0)
    image, depth = jnp.asarray(rng.random((9, 10, 2))), jnp.asarray(rng.uniform(2, 4, (9, 10)))
    method = ft.partial(getattr(dof, name), max_coc=8.0)
    lens = ThinLens(aperture, 1.8, 100.0)
    circles = lens.circle_of_confusion(depth)
    assert bool(((circles > 1) & (circles < 8)).any()) == is_moving

    @jax.jit
    def loss(lens, depth):
        return jnp.sum(method(image, depth, lens) ** 2)

    slopes = jax.tree.leaves(jax.grad(loss, argnums=(0, 1))(lens, depth))
    # Of `layered` rounding is left.
    largest = max(float(abs(slope).max()) for slope in slopes)
    assert largest > 1e-3 if is_moving else largest < 1e-11
