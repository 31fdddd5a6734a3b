"""Huber's loss and the jackknife, which fits share, against closed forms and plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.fit import _jackknife, _robust


CORNER = 1.345


@pytest.mark.parametrize("x", [0.0, 0.5, -1.0, 1.345, -1.345, 2.0, -50.0])
def test_half_the_square_is_hubers_loss(x):
    value = float(_robust.huber(jnp.asarray(x)))
    size = abs(x)
    loss = x * x / 2 if size <= CORNER else CORNER * (size - CORNER / 2)
    assert value * value / 2 == pytest.approx(loss, rel=1e-12)
    assert np.sign(value) == np.sign(x)


@pytest.mark.parametrize("x", [0.0, 0.5, 1.345, 2.0, -50.0])
def test_the_derivative_of_the_loss_is_the_clipped_residual(x):
    """At the corner too, where both pieces have the same one; in both modes."""
    loss = lambda x: _robust.huber(x) ** 2 / 2
    slope = np.clip(x, -CORNER, CORNER)
    assert float(jax.grad(loss)(jnp.asarray(x))) == pytest.approx(slope, abs=1e-12)
    pushed = jax.jvp(loss, (jnp.asarray(x),), (jnp.ones(()),))[1]
    assert float(pushed) == pytest.approx(slope, abs=1e-12)


def test_the_covariance_is_that_of_leaving_each_block_out():
    """A linear problem, solved again without each block; one block holds no residual."""
    rng = np.random.default_rng(0)
    columns, block = rng.normal(size=(90, 3)) * [1, 10, 1e-3], rng.integers(0, 9, 90)
    aim = rng.normal(size=90) + rng.normal(size=9)[block]
    best = np.linalg.lstsq(columns, aim, rcond=None)[0]
    without = [
        np.linalg.lstsq(columns[block != i], aim[block != i], rcond=None)[0] for i in range(9)
    ]
    away = np.array(without) - np.mean(without, axis=0)
    expected = 8 / 9 * away.T @ away
    residual = columns @ best - aim
    found = _jackknife.covariance(*map(jnp.asarray, (columns, residual, block)), 10)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-12)


def test_two_unknowns_that_are_hard_to_tell_apart_keep_their_digits():
    """Against a decomposition of the columns themselves; that of their square loses ten."""
    rng = np.random.default_rng(2)
    columns, block = rng.normal(size=(90, 3)) * [1, 1e-5, 10], np.arange(90) % 9
    columns[:, 1] += columns[:, 0]
    aim = rng.normal(size=90)
    solved = lambda kept: np.linalg.lstsq(columns[kept], aim[kept], rcond=None)[0]
    moves = np.array([solved(block != i) for i in range(9)])
    away = moves - np.mean(moves, axis=0)
    residual = columns @ solved(block >= 0) - aim
    found = _jackknife.covariance(*map(jnp.asarray, (columns, residual, block)), 9)
    np.testing.assert_allclose(found, 8 / 9 * away.T @ away, rtol=1e-8, atol=1e-12)
    inverse = np.linalg.pinv(columns, rcond=1e-14)
    errors = np.sqrt(np.sum(inverse**2, axis=1) * np.sum(residual**2) / 87)
    found = _jackknife.independent_errors(*map(jnp.asarray, (columns, residual)))
    np.testing.assert_allclose(found, errors, rtol=1e-8)


def test_what_nothing_tells_has_no_finite_error():
    rng = np.random.default_rng(1)
    columns, residual = rng.normal(size=(80, 3)), jnp.asarray(rng.normal(size=80))
    block = jnp.arange(80) % 8
    columns[:, 1] = 0
    found = np.asarray(_jackknife.covariance(jnp.asarray(columns), residual, block, 8))
    assert np.isinf(found[1]).all() and np.isfinite(found[np.ix_([0, 2], [0, 2])]).all()
    columns[:, 1] = columns[:, 0]  # The two can't be told apart.
    found = np.asarray(_jackknife.covariance(jnp.asarray(columns), residual, block, 8))
    assert found[0, 0] > 1e6 * found[2, 2] and found[1, 1] > 1e6 * found[2, 2]
    few = _jackknife.covariance(jnp.asarray(columns), residual, block % 2, 2)
    assert np.isinf(few).all()


def test_tiles_cover_an_image_of_any_size():
    for shape in ((16, 24, 3), (9, 7, 1), (3, 5, 2)):
        tile, count = _jackknife.tiles(shape)
        plane = np.asarray(tile).reshape(shape)
        assert count == 64 and (plane == plane[..., :1]).all()
        row, column = np.divmod(plane[..., 0], 8)
        np.testing.assert_array_equal(row[:, 0], np.arange(shape[0]) * 8 // shape[0])
        np.testing.assert_array_equal(column[0], np.arange(shape[1]) * 8 // shape[1])
