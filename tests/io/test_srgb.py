"""The sRGB curve."""

import inspect

import numpy as np
import pytest
from skimage.color import rgb2xyz

from jaxfx import io


@pytest.mark.parametrize("name", ["linear_from_srgb", "srgb_from_linear"])
def test_the_curve_of_other_types(name):
    curve, codes = inspect.unwrap(getattr(io, name)), np.linspace(0, 1, 101)
    for kind in (np.float16, np.float32, ">f4"):
        given = codes.astype(kind)
        found = curve(given)
        assert found.dtype == given.dtype.newbyteorder("=")
        exact = curve(given.astype(np.float64))
        # Computed in float32 or wider: a float16 result differs by its own rounding only.
        rounding = np.finfo(found.dtype).eps / 2 + 4 * np.finfo(np.float32).eps
        np.testing.assert_allclose(found.astype(float), exact, rtol=rounding, atol=1e-7)
    for wrong in (np.array([0, 127, 255], np.uint8), np.array([65535], np.uint16), [0, 1]):
        with pytest.raises(ValueError, match=rf"`{name}\(\w+\)` must hold floats.*got \w?int"):
            curve(wrong)
    with pytest.raises(ValueError, match=rf"`{name}\(\w+\)` .* got a masked array"):
        curve(np.ma.masked_array(codes))


def test_the_curve_against_scikit_image():
    codes = np.linspace(0, 1, 1001)
    # The luminance of a grey is its linear value.
    expected = rgb2xyz(np.stack([codes] * 3, axis=-1))[:, 1]
    np.testing.assert_allclose(io.linear_from_srgb(codes), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_the_curve_and_its_inverse(dtype):
    codes = np.linspace(-0.5, 2, 5001).astype(dtype)
    light = io.linear_from_srgb(codes)
    back = io.srgb_from_linear(light)
    assert light.dtype == back.dtype == dtype
    # The standard's two pieces differ by 3e-8 where they join.
    np.testing.assert_allclose(back, codes, rtol=20 * np.finfo(dtype).eps, atol=1e-7)
    assert np.all(np.diff(light) >= 0)


def test_the_curve_at_known_points():
    points = np.array([-0.001, 0.0, 0.0031308, 0.18, 1.0])
    codes = io.srgb_from_linear(points)
    np.testing.assert_allclose(codes, [-0.01292, 0, 0.04045, 0.461356, 1], atol=5e-7)
