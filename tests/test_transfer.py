"""The record of indirect light: what it refuses."""

import numpy as np
import pytest

from jaxfx import Transfer


FIELDS = {
    **{"receive": np.ones((3, 4, 2)), "send": np.ones((2, 5))},
    **{name: np.ones((5, 3)) for name in ("position", "normal", "diffuse")},
    "exchange": np.ones((5, 5)),
}


def test_fields_are_kept():
    for name, value in vars(Transfer(**FIELDS)).items():
        np.testing.assert_array_equal(value, FIELDS[name])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("send", np.ones(3), r"`Transfer\(send\)` must have shape \(rank, point\), got \(3,\)"),
        ("receive", np.ones((3, 4, 5)), r"`Transfer\(receive\)` must have shape \(height, wi"),
        ("exchange", np.ones((5, 3)), r"`Transfer\(exchange\)` must have shape"),
        ("normal", np.ones((4, 3)), r"`Transfer\(normal\)` must have shape"),
    ],
)
def test_errors_name_the_argument(name, value, message):
    with pytest.raises(ValueError, match=message):
        Transfer(**FIELDS | {name: value})
