"""An error spent tile by tile, and the blocks of pixels that are left."""

import numpy as np

from jaxfx.budget._tiles import blocks, spend, sums, tile_of


def test_tiles_hold_their_own_pixels_and_no_others():
    image = np.random.default_rng(0).uniform(size=(19, 21))
    found = sums(image.reshape(1, -1), tile_of((19, 21)))[:, 0]
    rows = [image[i : i + 8, j : j + 8].sum() for i in (0, 8, 16) for j in (0, 8, 16)]
    np.testing.assert_allclose(found, rows)


def test_an_error_is_spent_on_the_cheapest_steps_in_their_order():
    squares = np.array([[0, 1, 5, 6], [0, 2, 3, 30], [0, 0, 0, 9]], float)
    for budget, steps in ((0, [0, 0, 2]), (1.1, [1, 0, 2]), (4.1, [1, 2, 2]), (9.1, [3, 2, 2])):
        np.testing.assert_array_equal(spend(squares, budget**0.5, 1), steps)
    assert squares[[0, 1, 2], spend(squares, 5.0, 2)].sum() <= 50


def test_pixels_of_like_cost_share_a_block_and_none_is_lost():
    rng = np.random.default_rng(0)
    uses, cost = rng.random((2, 200_000)) < 0.7, rng.integers(0, 90, (2, 200_000))
    (found,) = blocks(uses, [np.zeros(3)] * 2, cost)
    item, pixels = np.asarray(found.item), np.asarray(found.pixels)
    for index in found.members:
        taken = pixels[item == index].ravel()
        taken = taken[taken < uses.shape[1]]
        np.testing.assert_array_equal(np.sort(taken), np.flatnonzero(uses[index]))
        assert (np.diff(cost[index, taken]) >= 0).all()
    assert pixels.shape[1] == 200_000 // 24
