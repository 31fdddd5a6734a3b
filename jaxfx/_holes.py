"""Holes in a depth map: from which known pixel each missing one copies its depth.

Used by `jaxfx.depth.fill`. Depths are height width: NaN where missing, positive or inf
elsewhere. A source is the flat index of a pixel; a known pixel is its own source.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import scan, while_loop
from jaxfx._platform import at_once


# Costs of a path, in units of the image's longer side, so that they do not depend on the
# resolution. Both were found by trial. `EDGE`: of a step over the guide's whole range. With
# less, depths leak over edges of the guide; with more, its noise stops paths. `NEARER`: at the
# rim of a hole, per factor of e by which the depth is nearer than expected. With less,
# foreground grows into holes; with more, the guide no longer matters.
EDGE = 1.25
NEARER = 0.25
# Passes of a 3 x 3 median over the filled pixels. With none, single pixels stand out.
MEDIANS = 2

Plane = Float[Array, "height width"]
Source = Int[Array, "height width"]
# The cost of the cheapest path to each pixel found so far, and the source at its start.
Paths = tuple[Plane, Source]


@jax.jit
def farther_ends(depth: Plane) -> Source:
    """The farther end of each gap in its row; in a row without any depth, in its column.

    Where no depth is known at all, pixels are their own sources.
    """
    height, width = depth.shape
    index = jnp.arange(height * width).reshape(height, width)
    along_rows = _farther_end(depth, index)
    depth_by_rows = depth.reshape(-1)[along_rows]
    return _farther_end(depth_by_rows.T, along_rows.T).T


def _farther_end(depth: Plane, source: Source) -> Source:
    """`source`, but in a gap of a row the source of the farther of the gap's two ends."""
    width = depth.shape[1]
    is_known = ~jnp.isnan(depth)
    column = jnp.arange(width)[None]
    before = jax.lax.cummax(jnp.where(is_known, column, -1), axis=1)
    behind = jax.lax.cummin(jnp.where(is_known, column, width), axis=1, reverse=True)

    def end(columns: Source, exists: Bool[Array, "height width"]) -> tuple[Plane, Source]:
        """Depth and source at the ends in `columns`; depth -inf where there is no end."""
        inside = jnp.clip(columns, 0, width - 1)
        end_depth = jnp.take_along_axis(depth, inside, axis=1)
        end_source = jnp.take_along_axis(source, inside, axis=1)
        return jnp.where(exists, end_depth, -jnp.inf), end_source

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
    """The known pixel from which the cheapest path leads to each pixel.

    A path goes from pixel to pixel, diagonals included. A step costs its length, and more where
    `guide` (linear, 0 to 1) changes. Where a path leaves the known pixels, it costs more if its
    depth is nearer than `expected` there, by the logarithm of their ratio. Finally each missing
    pixel takes the source of the median of its neighbourhood, `medians` times.
    """
    height, width = depth.shape
    unit = float(max(height, width))
    farthest = jnp.max(jnp.where(jnp.isfinite(depth), depth, 0))
    # The background counts as twice the farthest depth: beyond it, but with a finite logarithm.
    background = jnp.where(farthest > 0, 2 * farthest, 1)
    planes = [
        jnp.sqrt(jnp.clip(jnp.nan_to_num(guide), 0, 1)),
        jnp.log(jnp.minimum(depth, background)),
        jnp.log(jnp.minimum(expected, background)),
    ]
    # Rotated by a quarter turn for each of the four directions from which a step can come.
    rotated = [[jnp.rot90(plane, turns) for plane in planes] for turns in range(4)]
    steps = [_steps_down(image, log, limit, unit) for image, log, limit in rotated]
    is_known = ~jnp.isnan(depth)
    source = jnp.arange(height * width).reshape(height, width)
    paths = jnp.where(is_known, 0, jnp.inf).astype(depth.dtype), source

    _, source = at_once(_swept_until_still)(*jax.lax.stop_gradient((paths, steps)))
    for _ in range(medians):
        source = jnp.where(is_known, source, _median_sources(depth, source))
    return source


def _above(plane: Float[Array, "height width ..."]) -> list[Float[Array, "height width ..."]]:
    """The three pixels above each: left, middle, right; at the border the nearest inside."""
    height, width = plane.shape[:2]
    padded = jnp.pad(plane, [(1, 0), (1, 1)] + [(0, 0)] * (plane.ndim - 2), mode="edge")
    return [padded[:height, start : start + width] for start in range(3)]


def _steps_down(
    guide: Float[Array, "height width channel"],
    log_depth: Plane,
    log_expected: Plane,
    unit: float,
) -> Float[Array, "height 3 width"]:
    """The costs of the steps to each pixel from the three above it; `unit` is in pixels."""
    steps = []
    for length, guide_above, log_above in zip(
        (2**0.5, 1.0, 2**0.5), _above(guide), _above(log_depth), strict=True
    ):
        edge = jnp.mean(jnp.abs(guide - guide_above), axis=2)
        # NaN above: the step does not leave the known pixels.
        too_near = jnp.where(jnp.isnan(log_above), 0, jnp.maximum(log_expected - log_above, 0))
        steps.append(length + unit * (EDGE * edge + NEARER * too_near))
    return jnp.stack(steps, axis=1)


def _swept_until_still(paths: Paths, steps: list[Float[Array, "_ 3 _"]]) -> Paths:
    """The paths after sweeps from all four sides, until one changes none."""

    def sweep(state):
        before = paths = state[0]
        for step in steps:
            paths = jax.tree.map(jnp.rot90, _swept_down(paths, step))
        return paths, jnp.any(paths[0] < before[0])

    return while_loop(lambda s: s[1], sweep, (paths, jnp.array(True)))[0]


def _swept_down(paths: Paths, steps: Float[Array, "height 3 width"]) -> Paths:
    """The paths after each row in turn has taken the cheaper ones from the row above."""

    def row(above, here):
        (cost, source), step = here
        for i in range(3):
            offered, offered_source = (
                jnp.pad(a, 1, mode="edge")[i : i - 2 or None] for a in above
            )
            is_cheaper = offered + step[i] < cost
            cost = jnp.where(is_cheaper, offered + step[i], cost)
            source = jnp.where(is_cheaper, offered_source, source)
        return (cost, source), (cost, source)

    no_paths = jnp.full_like(paths[0][0], jnp.inf), paths[1][0]
    return scan(row, no_paths, (paths, steps))[1]


def _median_sources(depth: Plane, source: Source) -> Source:
    """The source of the median depth in the 3 x 3 pixels around each.

    At the border the nearest pixel inside is repeated.
    """
    height, width = source.shape
    padded = jnp.pad(source, 1, mode="edge")
    window = jnp.stack(
        [padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]
    )
    values = depth.reshape(-1)[window]
    order = jnp.argsort(values, axis=0)[4:5]
    return jnp.take_along_axis(window, order, axis=0)[0]
