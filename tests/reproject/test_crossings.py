"""Rays on a grid: where they come in, against small steps along each."""

import jax
import numpy as np

from jaxfx.reproject import _crossings


HEIGHT, WIDTH = 6, 9


def test_a_ray_comes_in_where_small_steps_first_find_it_inside():
    rng = np.random.default_rng(0)
    origin = rng.uniform(-8, 16, (600, 3))
    direction = rng.normal(size=(600, 3))

    @jax.jit
    def entry_texel(*ends):
        rays = _crossings.grid_rays(*map(_crossings.coordinates, ends))
        return _crossings.entry_texel(rays, HEIGHT, WIDTH)

    found = entry_texel(origin, direction)
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
    is_earlier, later = jax.jit(_crossings.is_earlier), jax.jit(_crossings.later)
    before, just_after = _crossings.Moment(1.0, False), _crossings.Moment(1.0, True)
    assert is_earlier(before, just_after) and not is_earlier(just_after, before)
    assert not is_earlier(before, before)
    assert later(before, just_after).after
    assert not later(just_after, _crossings.Moment(2.0, False)).after


def test_a_ray_to_the_left_is_beyond_a_border_just_after_it():
    texel_at = jax.jit(_crossings.texel_at)
    cell = lambda after, d, backward: int(
        texel_at(_crossings.Moment(1.0, after), 3.0 - d, d, backward)
    )
    assert cell(False, 1.0, False) == 3
    assert cell(False, -1.0, True) == 3
    assert cell(True, -1.0, True) == 2
