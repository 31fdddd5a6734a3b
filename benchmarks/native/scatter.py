"""Native peer of depth of field: scatter as one would write it in C, in numba."""

import math

import numba
import numpy as np


@numba.njit(parallel=True, fastmath=True, cache=True)
def _scatter(image, radius, coc, foreground, visibility, epsilon, bands):
    """Sums of sprites with a linear edge; every thread writes its own band of rows."""
    height, width, _ = image.shape
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    per_epsilon = one / epsilon
    sharp = np.empty_like(coc)
    for j in numba.prange(height):
        for i in range(width):
            sharp[j, i] = one - min(max(coc[j, i] * per_epsilon - one, zero), one)
    sums = np.zeros((4, height, width), np.float32)
    reach = math.ceil(radius.max() + half)
    for band in numba.prange(bands):
        first, last = band * height // bands, (band + 1) * height // bands
        for j in range(max(first - reach, 0), min(last + reach, height)):
            for i in range(width):
                r = radius[j, i]
                side = math.ceil(r + half) - 1
                amount = visibility[j, i] / max(
                    np.float32(math.pi) * r * r, np.float32(math.pi / 4)
                )
                red, green, blue = image[j, i, 0], image[j, i, 1], image[j, i, 2]
                c, near = coc[j, i], foreground[j, i]
                left, right = max(0, i - side), min(width, i + side + 1)
                for y in range(max(first, j - side), min(last, j + side + 1)):
                    row = np.float32((y - j) * (y - j))
                    for x in range(left, right):
                        column = np.float32(x - i)
                        distance = math.sqrt(row + column * column)
                        weight = amount * min(max(r + half - distance, zero), one)
                        if not near:
                            rise = min(max((c - coc[y, x]) * per_epsilon, zero), one)
                            weight *= one - sharp[y, x] * rise
                        sums[0, y, x] += weight * red
                        sums[1, y, x] += weight * green
                        sums[2, y, x] += weight * blue
                        sums[3, y, x] += weight
    return sums


def scatter(image, depth, lens, gamma, epsilon):
    """As `jaxfx.dof.scatter`, with a linear ramp as the sprites' edge."""
    aperture, focus, focal = map(float, (lens.aperture, lens.focus_distance, lens.focal_pixels))
    depth = depth.astype(np.float32)
    coc = np.float32(aperture * focal) * np.abs(np.float32(1 / focus) - 1 / depth)
    foreground = depth < focus
    visibility = np.where(foreground, (focus / depth) ** gamma, 1).astype(np.float32)
    sums = _scatter(
        image,
        coc / 2,
        coc,
        foreground,
        visibility,
        np.float32(epsilon),
        4 * numba.get_num_threads(),
    )
    return np.moveaxis(sums[:3] / sums[3], 0, -1)
