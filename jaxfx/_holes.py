"""Which known pixel each missing one copies its depth from.

Depths are height width, NaN where missing, positive or inf elsewhere; a source is the index of
a pixel, row by row. A known pixel is its own source.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


# In units of the image's longer side: what a step across all of the guide's range costs, and
# what a path pays at the rim of the hole where its depth is too near, by more than the ratio.
EDGE = 2.0
JUMP = 0.4
RATIO = 1.1
# Costs are whole numbers, this many to a pixel's side. So sums are exact, and a pixel has the
# source of the neighbour by which its path came, whatever the order of the search.
PARTS = 64
BEYOND = 2**30

Plane = Float[Array, "height width"]
Source = Int[Array, "height width"]
Cost = Int[Array, "height width"]
# What the path to each pixel costs, and where it comes from.
Paths = tuple[Cost, Source]


@jax.jit
def farther_ends(depth: Plane) -> Source:
    """The farther end of each gap in its row; in a row that knows nothing, in its column.

    Where a depth is known nowhere, pixels are their own sources.
    """
    height, width = depth.shape
    index = jnp.arange(height * width).reshape(height, width)
    along_rows = _farther_end(depth, index)
    whole_rows = depth.reshape(-1)[along_rows]
    return _farther_end(whole_rows.T, along_rows.T).T


def _farther_end(depth: Plane, source: Source) -> Source:
    """The `source` of each pixel; in a gap of a row, that of the farther of its two ends."""
    width = depth.shape[1]
    is_known = ~jnp.isnan(depth)
    column = jnp.arange(width)[None]
    before = jax.lax.cummax(jnp.where(is_known, column, -1), axis=1)
    behind = jax.lax.cummin(jnp.where(is_known, column, width), axis=1, reverse=True)

    def end(columns: Source, exists: Bool[Array, "height width"]) -> tuple[Plane, Source]:
        held = jnp.clip(columns, 0, width - 1)
        found = jnp.take_along_axis(depth, held, axis=1)
        return jnp.where(exists, found, -jnp.inf), jnp.take_along_axis(source, held, axis=1)

    first, first_source = end(before, before >= 0)
    second, second_source = end(behind, behind < width)
    farther = jnp.where(first >= second, first_source, second_source)
    is_gap = ~is_known & ~jnp.isneginf(jnp.maximum(first, second))
    return jnp.where(is_gap, farther, source)


@jax.jit
def cheapest_sources(
    depth: Plane, guide: Float[Array, "height width channel"], expected: Plane
) -> Source:
    """The source at the end of the cheapest path to each pixel, by steps across pixels' sides.

    A step costs its length, and more where `guide` (linear, 0 to 1) changes by more than it
    does all about: what is alike everywhere is a texture, no edge. A path pays where it leaves
    the known pixels with a depth that is nearer than `expected` there. The pixels of one
    source hang together by their sides.
    """
    height, width = depth.shape
    shown = jnp.sqrt(jnp.clip(jnp.nan_to_num(guide), 0, 1))
    planes = shown, _texture(shown), depth, expected
    unit = max(height, width)
    # A quarter turn for each of the four directions from which a step can come.
    steps = [
        _steps_down(*(jnp.rot90(plane, turn) for plane in planes), unit=unit)
        for turn in range(4)
    ]
    known = jnp.where(jnp.isnan(depth), jnp.int32(BEYOND), jnp.int32(0))
    source = jnp.arange(height * width).reshape(height, width)

    def sweep(state):
        before = paths = state[0]
        for step in steps:
            paths = jax.tree.map(jnp.rot90, _swept_down(paths, step))
        return paths, jnp.any(paths[0] < before[0])

    (_, source), _ = jax.lax.while_loop(
        lambda state: state[1], sweep, ((known, source), jnp.array(True))
    )
    return source


def _texture(guide: Float[Array, "height width channel"]) -> Plane:
    """The mean step of `guide` from a pixel to its sides, over the 3 x 3 about each."""
    padded = jnp.pad(guide, ((1, 1), (1, 1), (0, 0)), mode="edge")
    beside = padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]
    mean = jnp.mean(jnp.abs(jnp.stack(beside) - guide[None]), axis=(0, 3))
    for _ in range(2):
        padded = jnp.pad(mean, ((1, 1), (0, 0)), mode="edge")
        mean = ((padded[2:] + padded[1:-1] + padded[:-2]) / 3).T
    return mean


def _steps_down(
    guide: Float[Array, "height width channel"],
    texture: Plane,
    depth: Plane,
    expected: Plane,
    *,
    unit: int,
) -> Cost:
    """What the step to each pixel from the one above it costs; beyond all in the first row."""
    change = jnp.mean(jnp.abs(guide[1:] - guide[:-1]), axis=2)
    edge = jnp.maximum(change - jnp.minimum(texture[1:], texture[:-1]), 0)
    # Not so where the depth above is missing.
    jump = jnp.where(expected[1:] > RATIO * depth[:-1], JUMP, 0.0)
    cost = 1 + unit * (EDGE * edge + jump)
    whole = jnp.round(PARTS * cost).astype(jnp.int32)
    return jnp.pad(whole, ((1, 0), (0, 0)), constant_values=BEYOND)


def _swept_down(paths: Paths, steps: Cost) -> Paths:
    """Each row's paths after those that come from the row above."""

    def row(above, here):
        (cost, source), step = here
        offered = jnp.minimum(above[0] + step, BEYOND)
        is_better = offered < cost
        cost = jnp.where(is_better, offered, cost)
        source = jnp.where(is_better, above[1], source)
        return (cost, source), (cost, source)

    nothing = jnp.zeros_like(paths[0][0]), paths[1][0]
    return jax.lax.scan(row, nothing, (paths, steps))[1]
