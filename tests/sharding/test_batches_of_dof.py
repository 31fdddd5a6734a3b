"""Batches that are spread over eight devices, for each method of `dof`: see `test_batches`."""

import pytest

from tests.sharding.test_batches import assert_divided, on_meshes
from tests.test_transforms import CASES


@pytest.mark.full
@on_meshes([name for name in CASES if name.startswith("dof.")])
def test_every_method_and_its_gradient_are_computed_where_a_batch_lies(
    eight_devices, name, mesh
):
    assert_divided(eight_devices("batch", name=name, mesh=mesh))
