"""Slices that fill a lens from the front, against the equations in plain NumPy."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.dof.kernels import _layers
from jaxfx.dof.kernels._slices import Extent, Sheets


# Sprites reach 3 pixels; how many slices there are is for the data to say.
EXTENT = Extent(max_coc=7.0, slices=None)


@functools.cache
def random_sheets(count):
    """Sprites of radius 0.5 to 3 that go on 3 pixels beyond a frame of 20 x 30, some bright."""
    rng, size = np.random.default_rng(6), (26, 36)
    place = rng.uniform(-3, 3, (count, *size))
    radius = np.maximum(np.abs(place), 0.5)
    value = rng.uniform(0.2, 1, (count, 2, *size)) / (np.pi * radius * radius)[:, None]
    value[0, 0, 9:12, 9:11] *= 1e5
    value[1:] *= rng.uniform(0, 1, size)
    tilt = rng.uniform(-0.7, 0.7, (count, 2, *size)) / (radius + 0.5)[:, None]
    return Sheets(*map(jnp.asarray, (value, radius, tilt, place)))


def in_plain_numpy(reach, sheets):
    """The composite as the equations have it: every slice, every sprite, every pixel."""
    value, radius, tilt, place = map(np.asarray, sheets)
    height, width = (n - 2 * reach for n in radius.shape[1:])
    x, filled = np.arange(width) + 0.5, np.zeros((value.shape[1], height, width))
    late = filled.copy()
    for sheet, slice_ in itertools.product(range(len(value)), range(-3, 4)):
        arriving = np.zeros_like(filled)
        away = np.minimum(np.abs(place[sheet] - slice_), 1)
        share = 1 - 3 * away**2 + 2 * away**3
        for q, p in itertools.product(np.argwhere(share > 0), range(height)):
            at = (sheet, *q)
            row, r = p - (q[0] - reach), radius[at]
            t = np.clip([row - 0.5, row + 0.5], -r, r)
            area = (t * np.sqrt(r * r - t * t) + r * r * np.arcsin(t / r)) / 2
            half = area[1] - area[0]
            middle = q[1] - reach + 0.5 + tilt[at[0], 0, at[1], at[2]] * half**2 / 3
            cover = np.minimum(x + 0.5, middle + half) - np.maximum(x - 0.5, middle - half)
            weight = share[at[1:]] * (1 + tilt[at[0], 1, at[1], at[2]] * row)
            light = value[at[0], :, at[1], at[2], None] * np.maximum(cover, 0)
            arriving[:, p] += weight * light
        room = np.maximum(1 - filled[-1], 0)
        found = np.minimum(1, room / np.maximum(arriving[-1], 1e-300)) * arriving
        late += (0.1 + filled[-1] + found[-1] / 2) * found
        filled += found
    return np.concatenate([filled, late])


def assert_close(one, other):
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9 * np.abs(y).max())


@pytest.mark.full
def test_slices_are_composited_as_the_equations_have_it():
    sheets = random_sheets(2)
    expected = in_plain_numpy(3, sheets)
    for sums in (_layers.composited, _layers.plain):
        assert_close(jax.jit(functools.partial(sums, EXTENT))(sheets), expected)


def check_derivatives(extent):
    """Both modes, of several blocks' sprites, spans and taps, before and behind what fills."""
    sheets = random_sheets(2)
    rng = np.random.default_rng(1)
    one, other = (
        jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), sheets) for _ in range(2)
    )
    # Several directions are painted at once.
    several = jax.tree.map(lambda x, y: jnp.stack([x, y, x - 2 * y]), one, other)

    @jax.jit
    def derivatives(sheets, several):
        first = jax.tree.map(lambda x: x[0], several)
        dense = jax.jvp(functools.partial(_layers.plain, extent), (sheets,), (first,))[1]
        composited = functools.partial(_layers.composited, extent)
        push = jax.linearize(composited, sheets)[1]
        # Itself is as good a direction to pull back as any.
        return jax.vmap(push)(several), dense, jax.vjp(composited, sheets)[1](dense)[0]

    (tangent, second, third), dense, found = derivatives(sheets, several)
    assert_close(tangent, dense)
    assert_close(third, tangent - 2 * second)
    assert np.abs(np.asarray(tangent - second)).max() > 0.1
    product = sum(jnp.vdot(x, y) for x, y in zip(found, one, strict=True))
    np.testing.assert_allclose(product, jnp.vdot(dense, dense), rtol=1e-9)


@pytest.mark.full
def test_the_derivatives_of_slices_are_those_of_dense_sums():
    check_derivatives(EXTENT)
