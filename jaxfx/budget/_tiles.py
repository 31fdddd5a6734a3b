"""An error that is spent tile by tile, where it saves most."""

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int


# A plan's own picture may round a little otherwise than what it was chosen by.
_SPENT = 0.999


def tile_of(shape: tuple[int, int], side: int) -> Int[np.ndarray, " pixel"]:
    """For every pixel, row by row, the number of its tile of `side` x `side` pixels."""
    rows, columns = (np.arange(size) // side for size in shape)
    return (rows[:, None] * (columns[-1] + 1) + columns[None]).reshape(-1)


def sums(
    values: Float[ArrayLike, "level pixel"], tile: Int[np.ndarray, " pixel"]
) -> Float[np.ndarray, "tile level"]:
    """The sum of each level's values over each tile."""
    values = np.asarray(values, np.float64)
    return np.stack([np.bincount(tile, level) for level in values], axis=1)


def spend(
    squares: Float[np.ndarray, "tile level"], max_error: float, size: int
) -> Int[np.ndarray, " tile"]:
    """Up to which level to go in each tile: as many steps as the error allows, cheapest first.

    `squares` are the sums of squared errors in a tile at each level, 0 at the first; `size` is
    how many numbers the picture has.
    """
    price = np.diff(squares, axis=1)
    # A step waits for the dearest before it: so the steps of a tile are taken in order.
    order = np.argsort(np.maximum.accumulate(price, axis=1).ravel(), kind="stable")
    spent = np.maximum.accumulate(np.cumsum(price.ravel()[order]))
    steps = np.searchsorted(spent, (_SPENT * max_error) ** 2 * size, side="right")
    taken = np.zeros(price.size, bool)
    taken[order[:steps]] = True
    return taken.reshape(price.shape).sum(axis=1)
