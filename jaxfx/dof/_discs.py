"""Points that stand for a disc, for the methods that read a few taps."""

import math

import numpy as np
from jaxtyping import Float


# Scheuermann 2004: the centre and seven points of a Poisson distribution on the unit disc.
POISSON = (
    (0.0, 0.0),
    (0.527837, -0.085868),
    (-0.040088, 0.536087),
    (-0.670445, -0.179949),
    (-0.419418, -0.616039),
    (0.440453, -0.639399),
    (-0.757088, 0.349334),
    (0.574619, 0.685879),
)


def vogel(count: int) -> Float[np.ndarray, "count 2"]:
    """`count` points (x, y) of a spiral over the unit disc, its centre first.

    Each but the centre, which has half, stands for a ring of one area; successive points are
    a golden angle apart (Vogel 1979).
    """
    index = np.arange(count)
    radius = np.sqrt(index / (count - 0.5))
    angle = index * math.pi * (3 - math.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
