"""An error that is spent tile by tile, where it saves most, and the pixels that are left then.

An image is made of items: lights, or sources of a reprojection. Each is left out of the tiles
where that costs least. The pixels that an item is still drawn in are put into blocks of one
size, so that one program draws them, wherever they lie.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfx._arrays import ArrayLike


# The side of a tile, in pixels: a larger tile draws more pixels than need be, smaller ones take
# longer to choose from.
_SIDE = 8

# The least number of pixels in a block, since fewer would not fill a core; and the largest
# number of blocks of an image, since each reads its item again, which may be as large.
_BLOCK, _BLOCKS = 4096, 24

# The part of the error that is spent, a ratio: the rest is for rounding, which in a plan's own
# program differs from that of the images it was chosen by.
_SPENT = 0.999


class Blocks(eqx.Module):
    """Pixels in blocks, each block for one of several items that are alike in shape and type.

    - `members`: static; the indices of the items.
    - `item`: for each block, the place of its item among them.
    - `pixels`: indices, row by row; one past the image's last stands for none.
    """

    members: tuple[int, ...] = eqx.field(static=True)
    item: Int[Array, " block"]
    pixels: Int[Array, "block pixel"]


def blocks(
    uses: Bool[np.ndarray, "item pixel"],
    items: Sequence[Any],
    cost: Int[np.ndarray, "item pixel"] | None = None,
) -> tuple[Blocks, ...]:
    """The pixels that each item is used for, in blocks; those of like cost in one block.

    A block takes as long as the costliest of its pixels.
    """
    kinds: dict[str, list[int]] = {}
    for index in np.flatnonzero(uses.any(axis=1)).tolist():
        kinds.setdefault(str(jax.tree.map(jax.typeof, items[index])), []).append(index)
    size, made = min(max(_BLOCK, uses.shape[1] // _BLOCKS), uses.shape[1]), []
    for members in kinds.values():
        wanted = [np.flatnonzero(uses[index]) for index in members]
        if cost is not None:
            ranks = [cost[index, pixels] for index, pixels in zip(members, wanted, strict=True)]
            order = [np.argsort(rank, kind="stable") for rank in ranks]
            wanted = [pixels[first] for pixels, first in zip(wanted, order, strict=True)]
        filled = [
            np.pad(pixels, (0, -len(pixels) % size), constant_values=uses.shape[1])
            for pixels in wanted
        ]
        item = np.repeat(np.arange(len(members)), [len(pixels) // size for pixels in filled])
        arrays = item, np.concatenate(filled).reshape(-1, size)
        made.append(
            Blocks(tuple(members), *(jnp.asarray(array, jnp.int32) for array in arrays))
        )
    return tuple(made)


def tile_of(shape: tuple[int, int]) -> Int[np.ndarray, " pixel"]:
    """The index of each pixel's tile, pixels row by row."""
    rows, columns = (np.arange(size) // _SIDE for size in shape)
    return (rows[:, None] * (columns[-1] + 1) + columns[None]).reshape(-1)


def sums(
    values: Float[ArrayLike, "level pixel"], tile: Int[np.ndarray, " pixel"]
) -> Float[np.ndarray, "tile level"]:
    """The sum of each level's values over each tile."""
    values = np.asarray(values, np.float64)
    return np.stack([np.bincount(tile, level) for level in values], axis=1)


def tile_sums(image: Float[Array, "height width channel"]) -> Float[Array, " tile"]:
    """The sum over each tile and all channels."""
    image = jnp.sum(image, axis=-1)
    rows, columns = (-(-size // _SIDE) for size in image.shape)
    margin = [
        (0, count * _SIDE - size)
        for count, size in zip((rows, columns), image.shape, strict=True)
    ]
    tiles = jnp.pad(image, margin).reshape(rows, _SIDE, columns, _SIDE)
    return jnp.sum(tiles, axis=(1, 3)).ravel()


def spend(
    squares: Float[np.ndarray, "tile level"], max_error: float, size: int
) -> Int[np.ndarray, " tile"]:
    """The level to go to in each tile: as many steps as the error allows, cheapest first.

    `squares` are the sums of squared errors in a tile at each level, 0 at the first; `size` is
    the number of values of the image.
    """
    price = np.diff(squares, axis=1)
    # A step ranks with the costliest before it, so that the steps of a tile are taken in order.
    order = np.argsort(np.maximum.accumulate(price, axis=1).ravel(), kind="stable")
    spent = np.maximum.accumulate(np.cumsum(price.ravel()[order]))
    steps = np.searchsorted(spent, allowed(max_error, size), side="right")
    taken = np.zeros(price.size, bool)
    taken[order[:steps]] = True
    return taken.reshape(price.shape).sum(axis=1)


def allowed(max_error: float, size: int) -> float:
    """The sum of squared errors that an image of `size` values may have."""
    return (_SPENT * max_error) ** 2 * size
