"""The image on which depth of field is timed against native code: two discs before a wall."""

import numpy as np

from jaxfx import ThinLens


def two_discs(side, radius):
    """Image, depth and lens: a disc before the focus plane, one in it, and a wall behind.

    `radius`, in pixels, is that of the nearer disc's circle of confusion.
    """
    rng = np.random.default_rng(0)
    y, x = (np.mgrid[:side, :side] + 0.5) / side
    image = rng.random((side, side, 3))
    depth = np.full((side, side), 4.0)
    for cx, cy, r, z in ((0.65, 0.6, 0.2, 2.0), (0.35, 0.4, 0.18, 8 / 7)):
        inside = (x - cx) ** 2 + (y - cy) ** 2 < r * r
        depth[inside] = z
        image[inside] = image[inside] * 0.3 + rng.random(3) * 0.7
    # The near disc's circle is the largest; the wall's is two thirds of it.
    focal = 2 * radius / (7 / 8 - 1 / 2)
    return image.astype(np.float32), depth.astype(np.float32), ThinLens(1.0, 2.0, focal)
