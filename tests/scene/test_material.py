"""The sRGB curve and the samples of byte textures, against their definitions."""

import numpy as np
import pytest

from jaxfx.io import linear_from_srgb
from jaxfx.scene import Sampler
from jaxfx.scene._material import sample_texture, table


def test_srgb_curve():
    # Worked out by hand from IEC 61966-2-1: ((v + 0.055) / 1.055)^2.4 above 0.04045.
    np.testing.assert_allclose(
        linear_from_srgb(np.array([0, 0.02, 0.5, 1])),
        [0, 0.02 / 12.92, 0.21404114, 1],
        rtol=1e-7,
    )
    assert table(np.dtype(np.uint8), True)[188] == pytest.approx(0.5, abs=5e-3)
    assert table(np.dtype(np.uint8), False)[51] == pytest.approx(0.2)
    assert table(np.dtype(np.uint16), False)[13107] == pytest.approx(0.2)
    step = linear_from_srgb(np.array([0.04045 - 1e-9, 0.04045 + 1e-9]))
    assert np.ptp(step) < 1e-7


PLACES = {
    "repeat": lambda i, size: i % size,
    "clamp": lambda i, size: min(max(i, 0), size - 1),
    "mirror": lambda i, size: [*range(size), *reversed(range(size))][i % (2 * size)],
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "wrap", [("repeat", "clamp"), ("mirror", "repeat"), ("clamp", "mirror")]
)
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (3, 7)])
def test_reads_against_a_loop(shape, wrap, dtype):
    random = np.random.default_rng(3)
    largest = np.iinfo(dtype).max
    texture = random.integers(0, largest + 1, (*shape, 3)).astype(dtype)
    uv = random.uniform(-2, 3, (100, 2)).astype(np.float32)
    height, width = shape
    along_u, along_v = (PLACES[name] for name in wrap)

    def texel(i, j):
        return linear_from_srgb(texture[along_v(j, height), along_u(i, width)] / largest)

    def read(u, v):
        x, y = u * width - 0.5, (1 - v) * height - 0.5
        total = np.zeros(3)
        for j in (int(np.floor(y)), int(np.floor(y)) + 1):
            for i in (int(np.floor(x)), int(np.floor(x)) + 1):
                total += (1 - abs(x - i)) * (1 - abs(y - j)) * texel(i, j)
        return total

    found = sample_texture(texture, uv, srgb=True, sampler=Sampler(wrap))
    expected = [read(float(u), float(v)) for u, v in uv]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    near = sample_texture(texture, uv, srgb=True, sampler=Sampler(wrap, nearest=True))
    at = np.floor(np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], -1)).astype(int)
    np.testing.assert_allclose(near, [texel(*place) for place in at.tolist()], atol=1e-6)


def test_coordinates_far_away_stay_in_the_image():
    texture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    uv = np.array([[1e30, -1e30], [-3e7, 1e20]], np.float32)
    for wrap in ("repeat", "mirror", "clamp"):
        found = sample_texture(texture, uv, srgb=False, sampler=Sampler((wrap, wrap)))
        assert ((found >= 0) & (found <= 11 / 255)).all()
