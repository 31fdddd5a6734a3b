"""Scatter by spans: small sprites by `tiles`, all others painted row by row.

The leak rejection couples source and destination, and yet spans carry it exactly. It reads
`1 - sharp_q * clip01((C_p - C_q) / epsilon)`, and `sharp_q` is 0 from `C_q = 2 epsilon` on: so
where `C_p >= 3 epsilon` the clamp is 1 wherever it matters, and the factor is `1 - sharp_q`
whatever the source, a weight on the finished sum. Sources below 3 epsilon go by `tiles`, which
then reach 1.5 epsilon only. Foreground sources have no factor at all. The cost is pixels times
(epsilon squared + radius).

A running sum rounds what it carries: values that are large beside what a pixel sums to go by
`tiles` as well.

What it does not do well: below a radius of about eight, `tiles` are quicker.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import clip01
from jaxfx._platform import in_groups
from jaxfx._xla import sum_planes
from jaxfx.dof.kernels import _tiles
from jaxfx.dof.kernels._adjoint import Program, with_adjoint
from jaxfx.dof.kernels._span_painter import DIRECTIONS, Blocks, Discs, read, too_bright, write
from jaxfx.dof.kernels._taps import UNCOUPLED, Planes, inside, to_planes
from jaxfx.dof.sprites import POINT_RADIUS, Sprites


# Height and width of a block in pixels: enough discs to spread the overhead of a row; their
# steps fill a megabyte at a radius of 64. Larger blocks do not fit into a core's cache.
BLOCK = (32, 128)


def spans(sprites: Sprites, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    return jnp.moveaxis(_sums(reach, to_planes(sprites)), 0, -1)


def _parts(
    planes: Planes,
) -> tuple[Bool[Array, "height width"], Planes, list[Float[Array, "height width"]]]:
    """Which sprites go by tiles; those; the radii of the others before and behind the focus."""
    value, radius, leak, coc = planes
    direct = (coc < UNCOUPLED) | too_bright(value, radius)
    near = Planes(
        jnp.where(direct[None], value, 0), jnp.where(direct, radius, POINT_RADIUS), leak, coc
    )
    layers = [jnp.where(~direct & layer, radius, 0) for layer in (leak < 0, leak >= 0)]
    return direct, near, layers


def paint(
    reach: int, value: Float[Array, "value height width"], radius: Float[Array, "height width"]
) -> Float[Array, "value height width"]:
    """The sum of all discs, each its value times its coverage; a radius of 0 is no disc."""
    blocks = _blocks(reach, radius)
    planes = [*map(blocks.whole, (value, radius[None]))]

    def write_block(block, steps):
        discs = _there(_cut(blocks, planes, block))
        return write(blocks, blocks.places(radius.dtype), discs, steps)

    return blocks.paint(blocks.are_held(radius), write_block, (1, len(value)), value.dtype)


def paint_tangents(
    reach: int,
    value: Float[Array, "value height width"],
    radius: Float[Array, "height width"],
    value_dots: Float[Array, "direction value height width"],
    radius_dots: Float[Array, "direction height width"],
) -> Float[Array, "direction value height width"]:
    """The derivatives of `paint` along tangents of value and radius."""
    blocks = _blocks(reach, radius)
    planes = [*map(blocks.whole, (value, radius[None]))]
    directions, values, *size = value_dots.shape
    dots = [*map(blocks.whole, (value_dots.reshape(-1, *size), radius_dots))]

    def write_block(block, steps):
        discs = _cut(blocks, planes, block)
        there = discs.radius[:, None, None] > 0
        value_dot, radius_dot = (blocks.cut(x, block) for x in dots)
        value_dot = value_dot.reshape(-1, directions, values)
        moved = Discs(jnp.where(there, value_dot, 0), radius_dot)
        places = blocks.places(radius.dtype)
        return write(blocks, places, _there(discs), steps, moved, tangents_only=True)

    shape = directions, values
    painted = blocks.paint(blocks.are_held(radius), write_block, shape, value.dtype)
    return painted.reshape(*shape, *painted.shape[1:])


def _there(discs: Discs) -> Discs:
    """The discs, of which those that are none write nothing.

    Two steps that cancel would leave their rounding.
    """
    return discs._replace(value=jnp.where(discs.radius[:, None] > 0, discs.value, 0))


def read_back(
    reach: int,
    value: Float[Array, "value height width"],
    radius: Float[Array, "height width"],
    bar: Float[Array, "value height width"],
    bars: tuple[Float[Array, "value height width"], Float[Array, "height width"]],
    weight: Float[Array, "height width"] | None = None,
) -> tuple[Float[Array, "value height width"], Float[Array, "height width"]]:
    """The adjoint of `paint`, times `weight`, at `bar`, added to `bars`.

    These are the cotangents of value and radius.
    """
    blocks = _blocks(reach, radius)
    planes = [*map(blocks.whole, (value, radius[None]))]

    def read_block(block, steps, bars):
        discs = _cut(blocks, planes, block)
        found = read(blocks, blocks.places(radius.dtype), discs, steps)
        found = found.value, found.radius[:, None]
        return [blocks.added(x, block, y) for x, y in zip(bars, found, strict=True)]

    found = [*map(blocks.whole, (bars[0], bars[1][None]))]
    found = blocks.read_back(blocks.are_held(radius), read_block, bar, found, weight)
    height, width = radius.shape
    value_bar, radius_bar = (x[:, :height, :width] for x in found)
    return value_bar, radius_bar[0]


def _blocks(reach: int, radius: Float[Array, "height width"]) -> Blocks:
    # One more column on either side of a window, as rounding may carry an end that far.
    return Blocks(radius.shape, BLOCK, (reach, reach + 1))


def _cut(blocks: Blocks, planes: list[Array], block: Array) -> Discs:
    value, radius = (blocks.cut(x, block) for x in planes)
    return Discs(value, radius[:, 0])


def _forward(reach: int, planes: Planes) -> Float[Array, "value height width"]:
    _, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    sums = blurred[None] * paint(reach, value, behind)
    sums = sums + paint(reach, value, before)
    return sums + _tiles.forward(reach, near)


def _tangents(
    reach: int, planes: Planes, dots: Planes
) -> Float[Array, "direction value height width"]:
    direct, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    sums = paint_tangents(reach, value, behind, dots.value, dots.radius)
    blurred_dot = inside(planes.coc - 1)[None] * dots.coc
    sums = blurred[None, None] * sums
    sums = sums + blurred_dot[:, None] * paint(reach, value, behind)[None]
    sums = sums + paint_tangents(reach, value, before, dots.value, dots.radius)
    near_dots = dots._replace(
        value=jnp.where(direct[None, None], dots.value, 0),
        radius=jnp.where(direct[None], dots.radius, 0),
    )
    return sums + _tiles.tangents(reach, near, near_dots)


def _adjoint(reach: int, planes: Planes, bar: Float[Array, "value height width"]) -> Planes:
    # One after the other, each adding to what the last one left: so they share their memory.
    direct, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    near_bar = _tiles.adjoint(reach, near, bar)
    blurred_bar = sum_planes(bar * paint(reach, value, behind))
    bars = (
        jnp.where(direct[None], near_bar.value, 0),
        jnp.where(direct, near_bar.radius, 0),
    )
    bars = read_back(reach, value, before, bar, bars)
    bars = read_back(reach, value, behind, bar, bars, blurred)
    coc_bar = near_bar.coc + inside(planes.coc - 1) * blurred_bar
    return Planes(*bars, near_bar.leak, coc_bar)


SPANS = Program(_forward, in_groups(_tangents, DIRECTIONS), _adjoint)
_sums = with_adjoint(SPANS, _tiles.plain)
