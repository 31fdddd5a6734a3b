"""The sRGB curve and the reads of byte textures, against their definitions."""

import numpy as np
import pytest

from jaxfx.io import linear_from_srgb
from jaxfx.scene._color import LINEAR, SRGB, read_texture


def test_srgb_curve():
    # Worked out by hand from IEC 61966-2-1: ((v + 0.055) / 1.055)^2.4 above 0.04045.
    np.testing.assert_allclose(
        linear_from_srgb(np.array([0, 0.02, 0.5, 1])),
        [0, 0.02 / 12.92, 0.21404114, 1],
        rtol=1e-7,
    )
    assert SRGB[188] == pytest.approx(0.5, abs=5e-3)
    assert LINEAR[51] == pytest.approx(0.2)
    step = linear_from_srgb(np.array([0.04045 - 1e-9, 0.04045 + 1e-9]))
    assert np.ptp(step) < 1e-7


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (3, 7)])
def test_reads_against_a_loop(shape):
    random = np.random.default_rng(3)
    texture = random.integers(0, 256, (*shape, 3)).astype(np.uint8)
    uv = random.uniform(-2, 3, (200, 2)).astype(np.float32)
    height, width = shape

    def read(u, v):
        x, y = u * width - 0.5, (1 - v) * height - 0.5
        total = np.zeros(3)
        for j in (int(np.floor(y)), int(np.floor(y)) + 1):
            for i in (int(np.floor(x)), int(np.floor(x)) + 1):
                share = (1 - abs(x - i)) * (1 - abs(y - j))
                total += share * linear_from_srgb(texture[j % height, i % width] / 255)
        return total

    expected = [read(float(u), float(v)) for u, v in uv]
    np.testing.assert_allclose(read_texture(texture, uv, SRGB), expected, atol=1e-5)
