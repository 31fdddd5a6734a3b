"""Batches that are spread over eight devices along their first axis, effect by effect."""

import pytest

from tests.test_transforms import CASES, FUNCTIONS


QUICK = ("dof.gather", "shadow.edge_pcf")
MESHES = ("explicit", "auto", "shard_map")


def assert_divided(answer):
    """Equal to a single device, of which no other asks anything, and spread as it came."""
    assert answer["error"] < 1e-9
    assert answer["collectives"] == []
    assert answer["is_spread"]


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize("mesh", MESHES)
def test_a_batch_is_computed_where_it_lies(eight_devices, name, mesh):
    assert_divided(eight_devices("batch", name=name, mesh=mesh, gradient=False))


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("mesh", MESHES)
def test_every_function_and_its_gradient_are_computed_where_a_batch_lies(
    eight_devices, name, mesh
):
    if name not in FUNCTIONS and not CASES[name].is_option:
        pytest.skip("goes through the code of another case")
    # A score needs a whole window.
    size = (13, 11) if name.startswith("metrics.") else (9, 7)
    assert_divided(eight_devices("batch", name=name, mesh=mesh, size=size))


@pytest.mark.full
@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("name", ["dof.scatter", "reproject.warp"])
def test_a_batch_lies_along_one_axis_of_two(eight_devices, name, mesh):
    """On the other axis its devices hold the same, and are known to."""
    grid = {"shape": (4, 2), "names": ("batch", "other")}
    assert_divided(eight_devices("batch", name=name, mesh=mesh, **grid))
