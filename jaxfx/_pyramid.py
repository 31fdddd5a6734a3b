"""Minimum and maximum pyramids of any size, each one flat array.

Level 0 is the array itself. Level k has ceil(height / 2**k) rows and ceil(width / 2**k)
columns, and texel (j, i) of it covers rows [j 2**k, (j + 1) 2**k) of level 0 and the columns
likewise, as many as there are. The last level is a single texel.
"""

import itertools
from collections.abc import Callable
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


@final
class Pyramid(eqx.Module):
    """Every level, row by row and level after level.

    - `values`: all texels.
    - `shapes`: static; the height and width of each level.
    """

    values: Float[Array, " texels"]
    shapes: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @property
    def offsets(self) -> tuple[int, ...]:
        """Where in `values` each level starts."""
        sizes = [height * width for height, width in self.shapes]
        return tuple(itertools.accumulate(sizes[:-1], initial=0))

    def level(self, index: int) -> Float[Array, "height width"]:
        """One level as a picture."""
        start, (height, width) = self.offsets[index], self.shapes[index]
        return self.values[start : start + height * width].reshape(height, width)


def minimum_pyramid(depth: Float[Array, "height width"]) -> Pyramid:
    """No texel is farther than anything below it."""
    return _pyramid(depth, jnp.minimum, np.inf)


def maximum_pyramid(depth: Float[Array, "height width"]) -> Pyramid:
    """No texel is nearer than anything below it."""
    return _pyramid(depth, jnp.maximum, -np.inf)


def level_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """The height and width of every level, down to a single texel."""
    shapes = [(height, width)]
    while shapes[-1] != (1, 1):
        height, width = (-(-size // 2) for size in shapes[-1])
        shapes.append((height, width))
    return tuple(shapes)


def _pyramid(depth: Array, combine: Callable, nothing: float) -> Pyramid:
    shapes = level_shapes(*depth.shape)
    levels = [depth]
    for height, width in shapes[1:]:
        finer = levels[-1]
        room = [(0, 2 * height - finer.shape[0], 0), (0, 2 * width - finer.shape[1], 0)]
        padded = jax.lax.pad(finer, jnp.asarray(nothing, finer.dtype), room)
        rows = combine(padded[::2], padded[1::2])
        levels.append(combine(rows[:, ::2], rows[:, 1::2]))
    return Pyramid(jnp.concatenate([level.reshape(-1) for level in levels]), shapes)
