"""A naive percentage-closer filter, and random maps and receivers to try it on."""

import numpy as np
import pytest

from jaxfx import shadow


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


def random_case(seed=0, map_shape=(14, 17), shape=(9, 11), dtype=np.float64):
    """A map with holes, and receivers in it, about it, and behind the light."""
    rng = np.random.default_rng(seed)
    shadow_map = rng.uniform(1, 3, map_shape)
    shadow_map[rng.uniform(size=map_shape) < 0.1] = np.inf
    u, v = (rng.uniform(-4, count + 4, shape) for count in map_shape[::-1])
    z = rng.uniform(1, 3, shape)
    z[rng.uniform(size=shape) < 0.1] = -1
    fields = (u, v, z, rng.uniform(0, 0.2, shape))
    return shadow_map.astype(dtype), shadow.Receivers(*(f.astype(dtype) for f in fields))


@pytest.fixture
def case():
    return random_case()
