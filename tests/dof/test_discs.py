"""Points that stand for a disc."""

import numpy as np
import pytest

from jaxfx.dof._discs import vogel


@pytest.mark.parametrize("count", [1, 2, 8, 64])
def test_vogel_points_are_spread_over_the_disc(count):
    points = vogel(count)
    assert points.shape == (count, 2)
    assert (points[0] == 0).all()
    radius = np.hypot(*points.T)
    assert radius.max() < 1
    # A disc's mean square radius is 1/2; that of n points on equal rings is (n - 1) / (2n - 1).
    np.testing.assert_allclose(np.mean(radius**2), (count - 1) / (2 * count - 1))
    if count == 64:
        assert np.abs(points.mean(axis=0)).max() < 0.02
