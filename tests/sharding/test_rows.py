"""Images whose rows lie on eight devices, against one device."""

import pytest


QUICK = ("blur", "pcf")
SLOW = ("scatter", "layered", "gather", "separable")


def assert_same(answer):
    assert answer["error"] < 1e-9
    assert answer["is_spread"]


@pytest.mark.parametrize("name", QUICK)
def test_rows_are_computed_with_their_neighbours(eight_devices, name):
    answer = eight_devices("rows", name=name, mesh="explicit", height=40, counts=True)
    assert_same(answer)
    # One exchange with the device above and one with the device below.
    assert answer["collectives"] == ["collective-permute"] * 2 * (name == "blur")


@pytest.mark.full
@pytest.mark.parametrize("mesh", ["explicit", "auto"])  # They share a reference.
@pytest.mark.parametrize("height", [64, 61, 75])
@pytest.mark.parametrize("name", SLOW + QUICK)
def test_rows_of_any_height_are_those_of_one_device(eight_devices, name, mesh, height):
    assert_same(eight_devices("rows", name=name, mesh=mesh, height=height))


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "height"), [("layered, two", 96), ("layered, two", 90), ("layered, peel", 433)]
)
def test_rows_of_two_layers_see_as_far_as_is_documented(eight_devices, name, height):
    """A guessed second layer is found by steps that see far."""
    assert_same(eight_devices("rows", name=name, mesh="auto", height=height))


@pytest.mark.full
@pytest.mark.parametrize("mesh", ["explicit", "auto"])
@pytest.mark.parametrize("height", [16, 13])
def test_rows_of_a_view_are_shared_out(eight_devices, mesh, height):
    assert eight_devices("target_rows", mesh=mesh, height=height)["error"] < 1e-9


@pytest.mark.full
def test_memory_of_a_device_falls_with_their_number(eight_devices):
    found = {count: eight_devices("memory", count=count) for count in (1, 2, 8)}
    for name in ("argument", "output", "temp"):
        for count in (2, 8):
            # The halo of 10 rows, and what is left of a window, come on top.
            assert found[count][name] < 1.2 * found[1][name] / count, (name, found)
