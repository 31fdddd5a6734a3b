"""The orthographic camera; `test_pinhole.py` tests what both cameras share."""

import numpy as np
import pytest

from jaxfx import OrthographicCamera


def test_a_plane_looks_the_same_at_any_depth():
    camera = OrthographicCamera(4.0, [8.0, 6.0], np.eye(4))
    pixels, depth = camera.project(np.array([[1.0, -0.5, 2.0], [1.0, -0.5, 70.0]]))
    np.testing.assert_array_equal(pixels, [[12.0, 4.0]] * 2)
    np.testing.assert_array_equal(depth, [2, 70])
    origins, directions = camera.rays(height=2, width=3)
    np.testing.assert_array_equal(directions, np.broadcast_to([0, 0, 1], (2, 3, 3)))
    np.testing.assert_array_equal(origins[0, 0], [-7.5 / 4, -5.5 / 4, 0])


@pytest.mark.parametrize(
    ("fields", "name", "message"),
    [
        ((np.nan, [0, 0]), "pixels_per_unit", "must be positive, got nan"),
        ((np.inf, [0, 0]), "pixels_per_unit", "must be positive, got inf"),
        ((1.0, [0, np.nan]), "center", "must be finite, got"),
    ],
)
def test_ranges(fields, name, message):
    with pytest.raises(ValueError, match=rf"`OrthographicCamera\({name}\)` {message}"):
        OrthographicCamera(*fields, np.eye(4))
