"""Pyramids of any size, against the definition."""

import jax
import numpy as np
import pytest

from jaxfx._pyramid import maximum_pyramid, minimum_pyramid


SIZES = [(1, 1), (1, 2), (2, 3), (5, 1), (17, 5), (61, 64), (64, 257)]


@pytest.mark.parametrize("size", SIZES, ids="{0[0]}x{0[1]}".format)
@pytest.mark.parametrize(
    ("pyramid", "extreme"), [(minimum_pyramid, np.min), (maximum_pyramid, np.max)]
)
def test_each_texel_is_the_extreme_of_what_it_covers(pyramid, extreme, size):
    depth = np.random.default_rng(0).normal(size=size)

    @jax.jit
    def levels(depth):
        made = pyramid(depth)
        return made, [made.level(k) for k in range(len(made.shapes))]

    made, found = levels(depth)
    for k, level in enumerate(map(np.asarray, found)):
        side = 2**k
        assert level.shape == made.shapes[k] == tuple(-(-n // side) for n in size)
        for j, i in np.ndindex(*level.shape):
            covered = depth[j * side : (j + 1) * side, i * side : (i + 1) * side]
            assert level[j, i] == extreme(covered)
    assert made.shapes[-1] == (1, 1)
    assert len(made.values) == made.offsets[-1] + 1


def test_infinite_texels_stay():
    depth = np.full((3, 3), np.inf)
    depth[2, 2] = 1.0
    found = jax.jit(lambda depth: minimum_pyramid(depth).level(1))(depth)
    np.testing.assert_array_equal(found, [[np.inf, np.inf], [np.inf, 1.0]])
