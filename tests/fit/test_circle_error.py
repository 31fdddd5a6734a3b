"""Stated errors of a lens by what an effect draws wrong, and how often they hold."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import fit_coverage
from jaxfx.fit import _circle_error


@pytest.mark.parametrize("apart", [1.0, 1e-5])
def test_the_variances_are_those_of_solving_again_with_each_error(apart):
    """A linear problem of two photographs, solved for each stratum and kind of error.

    Two of its unknowns may be hard to tell apart.
    """
    rng = np.random.default_rng(0)
    defocus = 5 * rng.normal(size=(2, 3, 4))
    columns = rng.normal(size=(2, 12, 3, 4)) * [1, 10, 1e-3, 1]
    columns[..., 3] = columns[..., 0] + apart * columns[..., 3]
    widening = rng.normal(size=(2, 12, 3))
    circle = np.maximum(abs(defocus), 1).reshape(2, 12, 1)
    expected = np.zeros(4)
    for error in (0.05 * widening, 0.28 * widening / circle):
        for stratum in np.argsort(defocus.reshape(2, 12)).reshape(2, 6, 2).swapaxes(0, 1):
            wrong = np.zeros_like(error)
            for photograph, pixels in enumerate(stratum):
                wrong[photograph, pixels] = error[photograph, pixels]
            aim = columns.reshape(-1, 4), wrong.reshape(-1)
            expected += np.linalg.lstsq(*aim, rcond=None)[0] ** 2
    given = columns.reshape(-1, 4), widening.reshape(-1), defocus
    found = _circle_error.variances(*map(jnp.asarray, given))
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_equal_defocus_shares_a_stratum_and_missing_depth_spoils_none():
    plane = np.full((1, 6, 6), 3.0)
    is_shown = jnp.ones(plane.shape, bool)
    assert np.unique(_circle_error.strata(jnp.asarray(plane), is_shown)).size == 1
    plane[0, 0, 0] = np.nan
    rng = np.random.default_rng(1)
    columns, widening = rng.normal(size=(36, 2)), rng.normal(size=36)
    found = _circle_error.variances(*map(jnp.asarray, (columns, widening, plane)))
    assert np.isfinite(found).all() and (np.asarray(found) > 0).all()


@pytest.mark.parametrize("rounding", [0, 1e-7])
def test_an_even_background_changes_no_error(rounding):
    """Five sixths of an image that no lens changes, all at one defocus."""
    rng = np.random.default_rng(2)
    columns, widening = rng.normal(size=(120, 3)), rng.normal(size=120)
    defocus = rng.uniform(-6, 6, (1, 10, 12))
    alone = _circle_error.variances(*map(jnp.asarray, (columns, widening, defocus)))
    added = lambda values: rounding * rng.normal(size=(5 * len(values), *values.shape[1:]))
    with_background = (
        np.concatenate([columns, added(columns)]),
        np.concatenate([widening, added(widening)]),
        np.concatenate([defocus, np.full((1, 50, 12), 200.0)], axis=1),
    )
    found = _circle_error.variances(*map(jnp.asarray, with_background))
    np.testing.assert_allclose(found, alone, rtol=1e-5 if rounding else 1e-12)


@pytest.mark.full
@pytest.mark.usefixtures("optimised")
def test_intervals_hold_the_true_lens_of_a_photograph_by_many_passes():
    """Rooms on which nothing was chosen; `python -m benchmarks.fit_coverage` fits 120."""
    errors, stated, doubts = zip(*map(fit_coverage.fitted, range(300, 316)), strict=True)
    is_told = [not doubt for doubt in doubts]
    held = np.abs(errors) < 1.96 * np.array(stated)
    assert np.sum(is_told) >= 14
    assert held[is_told].mean(axis=0).min() >= 0.85


def test_an_unknown_that_changes_nothing_leaves_the_other_errors_as_they_are():
    """Two of the others are hard to tell apart: rounding mixes it with their difference."""
    rng = np.random.default_rng(3)
    columns, widening = rng.normal(size=(480, 4)), jnp.asarray(rng.normal(size=480))
    columns[:, 1] = columns[:, 0] + 1e-5 * columns[:, 1]
    defocus = jnp.asarray(rng.uniform(-6, 6, (1, 20, 24)))
    alone = _circle_error.variances(jnp.asarray(columns), widening, defocus)
    for at in range(5):
        beside = jnp.asarray(np.insert(columns, at, 0, axis=1))
        found = np.delete(_circle_error.variances(beside, widening, defocus), at)
        np.testing.assert_allclose(found, alone, rtol=1e-9)
