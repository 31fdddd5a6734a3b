"""Groups of slices of the layered method: each slice once, with a reach that its discs need."""

import math

import pytest

from jaxfx.dof.kernels._layer_rows import GROUP, _groups
from jaxfx.dof.kernels._slices import Extent


@pytest.mark.parametrize("max_coc", [1e-6, 0.3, 0.999, 1.0, 1.001, 1.4, 2.0, 3.0, 9.7, 64.0])
@pytest.mark.parametrize("threshold", [0.01, 0.1, 0.5, 1.0])
def test_every_slice_is_in_one_group_that_reaches_as_far_as_its_discs(max_coc, threshold):
    """Discs smaller than a pixel reach no other one, and end the halving of the reach."""
    extent = Extent(max_coc, max(math.ceil(max_coc / threshold), 1))
    thick = max_coc / 2 / max(extent.slices - 1, 1)
    found = []
    for first, groups, reach in _groups(extent, extent.slices):
        indices = range(first, first + groups * GROUP)
        found += indices
        largest = thick * (max(abs(i) for i in indices) + 1)
        assert extent.reach_of(largest) <= reach <= extent.reach
    slices = 2 * extent.slices + 1
    assert found[:slices] == [*range(-extent.slices, extent.slices + 1)]
    assert len(found) - slices < GROUP
