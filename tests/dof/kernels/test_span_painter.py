"""Discs painted by spans against their definition, and their adjoint against their tangent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.dof.kernels._spans import BLOCK, paint, paint_tangents, read_back
from jaxfx.dof.sprites import coverage, row_half_width


REACH = 5
# Two blocks down and two across: one and a half would be one.
SHAPE = (BLOCK[0] * 3 // 2 + 1, BLOCK[1] * 3 // 2 + 3)


def discs(seed):
    rng = np.random.default_rng(seed)
    value = jnp.asarray(rng.normal(size=(2, *SHAPE)))
    radius = rng.uniform(0.5, REACH + 0.5, SHAPE) * (rng.random(SHAPE) < 0.3)
    return value, jnp.asarray(radius)


def test_one_disc_is_its_coverage():
    share = jax.jit(lambda row, column: coverage(row_half_width(jnp.asarray(3.7), row), column))
    for row, column in (
        (0, 0),
        (SHAPE[0] // 2, SHAPE[1] // 2 - 1),
        (SHAPE[0] - 1, SHAPE[1] - 1),
    ):
        value, radius = np.zeros((1, *SHAPE)), np.zeros(SHAPE)
        value[0, row, column], radius[row, column] = 2.0, 3.7
        painted = np.asarray(jax.jit(paint, static_argnums=0)(REACH, value, radius))[0]
        expected = np.zeros(SHAPE)
        for y in range(max(0, row - 5), min(SHAPE[0], row + 6)):
            for x in range(max(0, column - 5), min(SHAPE[1], column + 6)):
                expected[y, x] = 2 * share(y - row, x - column)
        np.testing.assert_allclose(painted, expected, atol=1e-12)


@pytest.mark.full
def test_the_tangent_is_the_difference_quotient():
    (value, radius), dot = discs(0), discs(1)
    dot = dot[0], jnp.where(radius > 0.6, dot[1], 0)
    step = 1e-7
    ends = [paint(REACH, value + h * dot[0], radius + h * dot[1]) for h in (step, -step)]
    several = (jnp.stack([x, -x, 2 * x]) for x in dot)
    tangent, turned, twice = paint_tangents(REACH, value, radius, *several)
    np.testing.assert_allclose(turned, -tangent, atol=1e-12)
    np.testing.assert_allclose(twice, 2 * tangent, atol=1e-12)
    np.testing.assert_allclose(tangent, (ends[0] - ends[1]) / (2 * step), atol=2e-6)


@pytest.mark.full
def test_reading_back_is_the_transpose():
    (value, radius), dot = discs(2), discs(3)
    bar = jnp.asarray(np.random.default_rng(4).normal(size=value.shape))
    nothing = jnp.zeros_like(value), jnp.zeros_like(radius)
    bars = read_back(REACH, value, radius, bar, nothing)
    tangents = paint_tangents(REACH, value, radius, *(x[None] for x in dot))
    pushed = jnp.vdot(tangents[0], bar)
    pulled = sum(map(jnp.vdot, dot, bars))
    np.testing.assert_allclose(pushed, pulled, rtol=1e-11)
    again = jax.tree.map(lambda x, y: x - y, read_back(REACH, value, radius, bar, bars), bars)
    np.testing.assert_allclose(again[0], bars[0], atol=1e-12)
