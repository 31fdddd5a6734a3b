"""Which known pixel each missing one copies its depth from.

Depths are height width, NaN where missing, positive or inf elsewhere; a source is the index of
a pixel, row by row. A known pixel is its own source.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


# In units of the image's longer side: what a step across all of the guide's range costs, and
# what a path pays at the rim of the hole for each factor of e by which its depth is too near.
EDGE = 1.25
NEARER = 0.25
# How often filled pixels take the median of their neighbours.
MEDIANS = 2

Plane = Float[Array, "height width"]
Source = Int[Array, "height width"]
# What the path to each pixel costs, and where it comes from.
Paths = tuple[Plane, Source]


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


@functools.partial(jax.jit, static_argnames="medians")
def cheapest_sources(
    depth: Plane,
    guide: Float[Array, "height width channel"],
    expected: Plane,
    medians: int = MEDIANS,
) -> Source:
    """The source at the end of the cheapest path to each pixel, from pixel to pixel.

    A step costs its length, and more where `guide` (linear, 0 to 1) changes. A path pays where
    it leaves the known pixels if its depth is nearer than `expected` there, by the logarithm
    of their ratio. At last each missing pixel takes the median of its neighbours, `medians`
    times.
    """
    height, width = depth.shape
    unit = float(max(height, width))
    farthest = jnp.max(jnp.where(jnp.isfinite(depth), depth, 0))
    # A sky is as if twice as far as the farthest: beyond all, and within reach.
    sky = jnp.where(farthest > 0, 2 * farthest, 1)
    planes = [
        jnp.sqrt(jnp.clip(jnp.nan_to_num(guide), 0, 1)),
        jnp.log(jnp.minimum(depth, sky)),
        jnp.log(jnp.minimum(expected, sky)),
    ]
    # A quarter turn for each of the four directions from which a step can come.
    turned = [[jnp.rot90(plane, turn) for plane in planes] for turn in range(4)]
    steps = [_steps_down(shown, log, limit, unit) for shown, log, limit in turned]
    is_known = ~jnp.isnan(depth)
    source = jnp.arange(height * width).reshape(height, width)
    paths = jnp.where(is_known, 0, jnp.inf).astype(depth.dtype), source

    def sweep(state):
        before = paths = state[0]
        for step in steps:
            paths = jax.tree.map(jnp.rot90, _swept_down(paths, step))
        return paths, jnp.any(paths[0] < before[0])

    (_, source), _ = jax.lax.while_loop(lambda s: s[1], sweep, (paths, jnp.array(True)))
    for _ in range(medians):
        source = jnp.where(is_known, source, _median_sources(depth, source))
    return source


def _above(plane: Float[Array, "height width ..."]) -> list[Float[Array, "height width ..."]]:
    """For each pixel the three above it, the frame's own repeated."""
    height, width = plane.shape[:2]
    padded = jnp.pad(plane, [(1, 0), (1, 1)] + [(0, 0)] * (plane.ndim - 2), mode="edge")
    return [padded[:height, start : start + width] for start in range(3)]


def _steps_down(
    guide: Float[Array, "height width channel"], log_depth: Plane, log_limit: Plane, unit: float
) -> Float[Array, "height 3 width"]:
    """What the steps to each pixel cost, from the three above it."""
    steps = []
    for length, other, carried in zip(
        (2**0.5, 1.0, 2**0.5), _above(guide), _above(log_depth), strict=True
    ):
        edge = jnp.mean(jnp.abs(guide - other), axis=2)
        too_near = jnp.where(jnp.isnan(carried), 0, jnp.maximum(log_limit - carried, 0))
        steps.append(length + unit * (EDGE * edge + NEARER * too_near))
    return jnp.stack(steps, axis=1)


def _swept_down(paths: Paths, steps: Float[Array, "height 3 width"]) -> Paths:
    """Each row's paths after those that come from the row above."""

    def row(above, here):
        (cost, source), step = here
        for i in range(3):
            offered, offered_source = (
                jnp.pad(a, 1, mode="edge")[i : i - 2 or None] for a in above
            )
            is_better = offered + step[i] < cost
            cost = jnp.where(is_better, offered + step[i], cost)
            source = jnp.where(is_better, offered_source, source)
        return (cost, source), (cost, source)

    nothing = jnp.full_like(paths[0][0], jnp.inf), paths[1][0]
    return jax.lax.scan(row, nothing, (paths, steps))[1]


def _median_sources(depth: Plane, source: Source) -> Source:
    """The source of the median of the 3 x 3 pixels about each, the frame's own repeated."""
    height, width = source.shape
    padded = jnp.pad(source, 1, mode="edge")
    window = jnp.stack(
        [padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]
    )
    values = depth.reshape(-1)[window]
    order = jnp.argsort(values, axis=0)[4:5]
    return jnp.take_along_axis(window, order, axis=0)[0]
