"""The arguments that all filters share: what is refused, and under which name."""

import inspect

import numpy as np
import pytest

from benchmarks.scenes.shadow import noise
from jaxfx import shadow


@pytest.mark.parametrize("size", [0, 2, 4, -3, 3.0, True])
@pytest.mark.parametrize("name", ["pcf", "prefiltered"])
def test_a_size_that_is_not_odd_is_refused(case, name, size):
    function = inspect.unwrap(getattr(shadow, name))
    with pytest.raises(ValueError, match=rf"`{name}\(size=...\)` must be an odd number"):
        function(*case, size=size)


def test_other_errors_name_their_argument(case):
    pcf = inspect.unwrap(shadow.pcf)
    shadow_map, receivers = case
    errors = {
        "shadow_map": ((shadow_map[0], receivers), {}),
        "receivers": ((shadow_map, receivers._replace(u=receivers.u[:2])), {}),
        "kernel=...": (case, {"kernel": "disc"}),
        "softness=...": (case, {"softness": 0.0}),
        "bias=...": (case, {"bias": np.zeros(2)}),
    }
    for name, (data, options) in errors.items():
        with pytest.raises(ValueError) as caught:
            pcf(*data, size=3, **options)
        assert str(caught.value).startswith(f"`pcf({name})`")


def test_an_integer_map_is_read_as_depths():
    _, receivers = noise()
    whole = np.random.default_rng(1).integers(1, 4, (14, 17))
    found, expected = (shadow.pcf(m, receivers, size=3) for m in (whole, whole.astype(float)))
    np.testing.assert_array_equal(found, expected)
