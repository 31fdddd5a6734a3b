"""Rays on a grid: where they come in, against small steps along each."""

import jax.numpy as jnp
import numpy as np

from jaxfx.reproject import _crossings


HEIGHT, WIDTH = 6, 9


def test_a_ray_comes_in_where_small_steps_first_find_it_inside():
    rng = np.random.default_rng(0)
    origin = rng.uniform(-8, 16, (600, 3))
    direction = rng.normal(size=(600, 3))
    ends = (_crossings.coordinates(jnp.asarray(end)) for end in (origin, direction))
    found = _crossings.entry_texel(_crossings.grid_rays(*ends), HEIGHT, WIDTH)
    times = np.linspace(0, 60, 60_001)
    seen = 0
    for o, d, x, y, inside in zip(origin, direction, *map(np.asarray, found), strict=True):
        column, row = (np.floor(o[k] + times * d[k]).astype(int) for k in (0, 1))
        within = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        # A ray that cuts a corner may be inside for less than a step.
        assert inside or not within.any()
        if np.count_nonzero(within) > 10:
            first = np.argmax(within)
            near = abs(column[first] - x) <= 1 and abs(row[first] - y) <= 1
            same = (column[first], row[first]) == (x, y)
            seen += same
            assert inside and near
    assert seen > 100


def test_of_two_moments_at_one_time_the_one_before_comes_first():
    at = lambda time, after: _crossings.Moment(jnp.asarray(time), jnp.asarray(after))
    before, just_after = at(1.0, False), at(1.0, True)
    assert _crossings.is_earlier(before, just_after) and not _crossings.is_earlier(
        just_after, before
    )
    assert not _crossings.is_earlier(before, before)
    assert _crossings.later(before, just_after).after
    assert not _crossings.later(just_after, at(2.0, False)).after


def test_a_ray_to_the_left_is_beyond_a_border_just_after_it():
    moment = lambda after: _crossings.Moment(jnp.asarray(1.0), jnp.asarray(after))
    cell = lambda after, d, backward: int(
        _crossings.texel_at(
            moment(after), jnp.asarray(3.0 - d), jnp.asarray(d), jnp.asarray(backward)
        )
    )
    assert cell(False, 1.0, False) == 3
    assert cell(False, -1.0, True) == 3
    assert cell(True, -1.0, True) == 2
