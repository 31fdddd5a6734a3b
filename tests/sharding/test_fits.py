"""Fits of frames or starts that are spread over eight devices."""

import pytest

from tests.helpers.fits import FITS
from tests.sharding.test_batches import MESHES, assert_divided


@pytest.mark.full
@pytest.mark.parametrize("mesh", MESHES)  # Mesh after mesh: they share the fit on one device.
@pytest.mark.parametrize("name", FITS)
def test_each_fit_is_searched_where_its_frame_lies(eight_devices, name, mesh):
    assert_divided(eight_devices("fits", name=name, mesh=mesh))
