"""The tiles where there are several of them, against the kernel that has none."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.dof.kernels._shift import shift
from jaxfx.dof.kernels._tiles import TILE, _tile_reaches, tiles
from jaxfx.dof.sprites import Sprites


REACH = 18
SHAPE = (2 * TILE[0] + 5, 2 * TILE[1] + 3)


def sprites():
    """Most of it in focus; a few large sprites beside the borders between tiles."""
    rng = np.random.default_rng(0)
    coc = rng.uniform(0.0, 3.0, SHAPE)
    for row, column in ((TILE[0] - 1, TILE[1] - 1), (TILE[0], 3), (SHAPE[0] - 1, SHAPE[1] - 1)):
        coc[row, column] = 2 * REACH
    leak = np.where(rng.random(SHAPE) < 0.3, -1.0, coc)
    value = rng.uniform(0.5, 1.0, (*SHAPE, 3))
    radius = np.maximum(coc / 2, 0.5)
    return Sprites(*map(jnp.asarray, (value, radius, leak, coc)), jnp.asarray(1.7))


@ft.cache
def sums_and_gradient(kernel):
    def loss(sprites):
        sums = kernel(sprites, REACH)
        weight = jnp.sin(jnp.arange(sums.size, dtype=sums.dtype) ** 2).reshape(sums.shape)
        return jnp.sum(weight * sums), sums

    return jax.jit(jax.value_and_grad(loss, has_aux=True))(sprites())


@pytest.mark.full
def test_many_tiles_have_the_same_sums():
    (_, expected), _ = sums_and_gradient(shift)
    (_, result), _ = sums_and_gradient(tiles)
    np.testing.assert_allclose(result, expected, atol=1e-10)


@pytest.mark.parametrize("field", Sprites._fields)
@pytest.mark.full
def test_many_tiles_have_the_same_gradient(field):
    _, expected = sums_and_gradient(shift)
    _, result = sums_and_gradient(tiles)
    assert np.abs(getattr(expected, field)).max() > 1e-3
    np.testing.assert_allclose(getattr(result, field), getattr(expected, field), atol=1e-8)


def test_reaches_are_those_of_a_search():
    radius = np.asarray(sprites().radius)
    tall, wide = TILE
    far = np.ceil(radius - 0.5).astype(int)
    rows, columns = np.indices(radius.shape)
    sources, destinations = [], []
    for top in range(0, SHAPE[0], tall):
        for left in range(0, SHAPE[1], wide):
            down = np.maximum(np.maximum(top - rows, rows - (top + tall - 1)), 0)
            across = np.maximum(np.maximum(left - columns, columns - (left + wide - 1)), 0)
            sources.append(far[top : top + tall, left : left + wide].max())
            destinations.append(far[np.maximum(down, across) <= far].max())
    spread = _tile_reaches(jnp.asarray(radius), tall, wide, spread=True)
    np.testing.assert_array_equal(
        _tile_reaches(jnp.asarray(radius), tall, wide, spread=False), sources
    )
    # By tiles, not by pixels: never less, and no farther than the farthest of all.
    assert (np.asarray(spread) >= destinations).all()
    assert np.asarray(spread).max() == far.max()
