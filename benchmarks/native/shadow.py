"""Native peer of shadows: percentage-closer filtering of every receiver, in numba."""

import math

import numba
import numpy as np


@numba.njit(parallel=True, cache=True)
def _count(shadow_map, u, v, threshold, size, lit):
    """Fills the visibility of each receiver, in scalar code as in C."""
    rows, columns = shadow_map.shape
    half = size // 2
    for j in numba.prange(u.shape[0]):
        for i in range(u.shape[1]):
            left, top = math.floor(u[j, i]) - half, math.floor(v[j, i]) - half
            first, last = max(left, 0), min(left + size, columns)
            bar, shadowed = threshold[j, i], 0
            for y in range(max(top, 0), min(top + size, rows)):
                for x in range(first, last):
                    shadowed += shadow_map[y, x] < bar
            lit[j, i] = np.float32(1) - np.float32(shadowed) / np.float32(size * size)


def pcf(shadow_map, receivers, size, bias):
    """Visibility by `size` x `size` texels, of receivers that lie before the light."""
    u, v, z, _ = receivers
    lit = np.empty(u.shape, np.float32)
    _count(shadow_map, u, v, z - np.float32(bias), size, lit)
    return lit
