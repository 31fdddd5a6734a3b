"""The page on many devices: its blocks run, and hold what it counts."""

import pytest


@pytest.mark.full
def test_the_page_on_many_devices_computes_what_one_device_does(eight_devices):
    answer = eight_devices("page")
    assert answer["error"] < 1e-9
    assert answer["collectives"] == ["all-reduce"]
