"""Minimum and maximum pyramids of any size, each one flat array.

Level 0 is the array itself. Level k has ceil(height / 2**k) rows and ceil(width / 2**k)
columns. Its cell (j, i) covers rows [j 2**k, (j + 1) 2**k) of level 0 and the columns likewise,
as far as there are any. The last level is a single cell.
"""

import itertools
from collections.abc import Callable
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._platform import kept


@final
class Pyramid(eqx.Module):
    """All levels in one array, level after level and each row by row.

    - `values`: all cells.
    - `shapes`: static; the height and width of each level.
    """

    values: Float[Array, " cell"]
    shapes: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @property
    def offsets(self) -> tuple[int, ...]:
        """Where in `values` each level starts."""
        sizes = [height * width for height, width in self.shapes]
        return tuple(itertools.accumulate(sizes[:-1], initial=0))

    def level(self, index: int) -> Float[Array, "height width"]:
        """One level as an image, height width."""
        start, (height, width) = self.offsets[index], self.shapes[index]
        return self.values[start : start + height * width].reshape(height, width)


def minimum_pyramid(values: Float[Array, "height width"]) -> Pyramid:
    """The pyramid of minima: no cell is farther than any texel that it covers."""
    return _pyramid(values, jnp.minimum, np.inf)


def maximum_pyramid(values: Float[Array, "height width"]) -> Pyramid:
    """The pyramid of maxima: no cell is nearer than any texel that it covers."""
    return _pyramid(values, jnp.maximum, -np.inf)


def level_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """The height and width of every level, down to a single cell."""
    shapes = [(height, width)]
    while shapes[-1] != (1, 1):
        height, width = (-(-size // 2) for size in shapes[-1])
        shapes.append((height, width))
    return tuple(shapes)


def _pyramid(values: Array, combine: Callable, identity: float) -> Pyramid:
    """The pyramid by `combine`, whose `identity` pads levels of odd size."""
    shapes = level_shapes(*values.shape)
    levels = [values]
    for height, width in shapes[1:]:
        finer = levels[-1]
        padding = [(0, 2 * height - finer.shape[0], 0), (0, 2 * width - finer.shape[1], 0)]
        padded = jax.lax.pad(finer, jnp.asarray(identity, finer.dtype), padding)
        rows = combine(padded[::2], padded[1::2])
        level = combine(rows[:, ::2], rows[:, 1::2])
        # Every second one in memory: an accelerator else computes each from all finer ones.
        levels.append(kept(level) if len(levels) % 2 == 0 else level)
    return Pyramid(jnp.concatenate([level.reshape(-1) for level in levels]), shapes)
