"""A naive percentage-closer filter, and a random map with receivers to try it on."""

import numpy as np
import pytest

from benchmarks.scenes.shadow import noise


def naive_pcf(shadow_map, receivers, size, bias=0.0, slope_bias=0.0):
    """One comparison at a time, as the definition reads."""
    rows, columns = shadow_map.shape
    u, v, z, slope = map(np.asarray, receivers)
    visible = np.zeros(z.shape)
    for j, i in np.ndindex(*z.shape):
        threshold = z[j, i] - (bias + slope_bias * slope[j, i])
        for dy, dx in np.ndindex(size, size):
            x = int(np.floor(u[j, i])) + dx - size // 2
            y = int(np.floor(v[j, i])) + dy - size // 2
            inside = 0 <= x < columns and 0 <= y < rows
            shadowed = z[j, i] > 0 and inside and shadow_map[y, x] < threshold
            visible[j, i] += not shadowed
    return visible / size**2


@pytest.fixture
def case():
    return noise()
