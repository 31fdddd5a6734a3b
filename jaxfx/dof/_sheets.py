"""The sums of `layered`: sprites that know the slope of their surface, sorted at every pixel.

Each layer is a sheet. A sheet's sprite p has at q the weight of its disc there, times how far
the surface faces q, `1 - tilt_p . (p - q)`: where the defocus changes along a surface, its
points crowd together as seen from one side of the lens and thin out from the other.

It lies in front of, on or behind the surface of q by what of `defocus_p - defocus_q` the
slopes do not explain. All of 0 to `(slope_p + slope_q) . (p - q) / 2` is explained, the
trapezoid rule that is exact for a quadratic; one unit beyond is another surface altogether.

Two programs for the same sums: `shifted`, one shifted multiply-add an offset, which is
differentiated, and `tiled`, which runs each tile only as far as the sprites that reach it.
"""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float, Int

from jaxfx.dof._sprites import POINT_RADIUS, coverage, row_half_width, segment_integral
from jaxfx.dof._tiles import _tile_reaches


# Small enough for the cache to hold the weights of a run.
TILE = (16, 128)
# A row of taps is worked through in runs; the middle one goes as far as NEAR to both sides.
RUN, NEAR = 17, 8
# Below this `shifted` is quick enough, and compiles sooner than `tiled`.
FEW_TAPS = 2**21


class Sheet(NamedTuple):
    """One layer of sprites.

    - `value`: the channels and a one, times the share of the sprite that is let through, over
      its area.
    - `radius`: pixels. `through`: that share.
    - `defocus`: signed diameter, in thresholds. `slope`: its derivatives along x and y.
    - `tilt`: the derivatives of the logarithm of the defocus, without unit.
    """

    value: Float[Array, "value height width"]
    radius: Float[Array, "height width"]
    through: Float[Array, "height width"]
    defocus: Float[Array, "height width"]
    slope: Float[Array, "2 height width"]
    tilt: Float[Array, "2 height width"]


class Sums(NamedTuple):
    """What arrives at each pixel.

    - `light`: in front, on the same surface, and behind: the sums of the weighted values.
    - `open`: the share of the pixel's own disc that no surface in front of it hides.
    """

    light: tuple[Float[Array, "value height width"], ...]
    open: Float[Array, "height width"]


def _arriving(there, cover, here, x, y):
    """The weight of a sprite at `(x, y)` from a pixel, and where it lies: from -1, in front of
    the surface `here`, to 1, behind it.
    """
    difference = there.defocus - here.defocus
    slope_x, slope_y = (there.slope + here.slope) / 2
    bent = slope_x * x + slope_y * y
    low, high = jnp.where(bent < 0, bent, 0), jnp.where(bent > 0, bent, 0)
    explained = jnp.where(difference < low, low, jnp.where(difference > high, high, difference))
    facing = 1 - there.tilt[0] * x - there.tilt[1] * y
    return cover * _clip(facing, 0, 2), _clip(difference - explained, -1, 1)


def _sorted(weight, place):
    """A weight's parts in front, on the surface and behind, and the share in front."""
    front, behind = jnp.where(place < 0, -place, 0), jnp.where(place < 0, 0, place)
    return (weight * front, weight * (1 - front - behind), weight * behind), front


def _add(sums, parts, values, throughs, own_cover):
    """What the sprites of all sheets at one offset add to the `Sums`."""
    light, covered = sums.light, 1.0
    for (shares, front), value, through in zip(parts, values, throughs, strict=True):
        light = [x + share[None] * value for x, share in zip(light, shares, strict=True)]
        # Where the first sheet is in front the second may show the surface all the same.
        covered = covered * (1 - through * (1 - front))
    return Sums(tuple(light), sums.open + own_cover * (1 - covered))


def _clip(x, low, high):
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def _padded(sheet: Sheet, margin: tuple[tuple[int, int], tuple[int, int]]) -> Sheet:
    """A sheet that goes on beyond the frame as it ends there."""

    def pad(plane):
        return jnp.pad(plane, [(0, 0)] * (plane.ndim - 2) + [*margin], mode="edge")

    return jax.tree.map(pad, sheet)


def _cut(tree, y, x, height, width):
    """A window of every plane."""

    def cut(plane):
        plane = jax.lax.dynamic_slice_in_dim(plane, y, height, axis=-2)
        return jax.lax.dynamic_slice_in_dim(plane, x, width, axis=-1)

    return jax.tree.map(cut, tree)


def shifted(reach: int, sheets: list[Sheet]) -> Sums:
    """The sums, by a loop over all offsets."""
    here = sheets[0]
    height, width = here.radius.shape
    own_area = jnp.pi * here.radius * here.radius
    sheets = [_padded(sheet, ((reach, reach), (reach, reach))) for sheet in sheets]
    offsets = jnp.arange(-reach, reach + 1)

    def add_row(sums, y):
        rows = _cut(sheets, reach + y, 0, height, width + 2 * reach)
        spans = [row_half_width(sheet.radius, y) for sheet in rows]
        own_span = row_half_width(here.radius, y)

        def add_tap(sums, x):
            there, span = _cut((rows, spans), 0, reach + x, height, width)
            own_cover = coverage(own_span, x) / own_area
            covers = [coverage(each, x) for each in span]
            x_, y_ = (each.astype(own_area.dtype) for each in (x, y))
            parts = [
                _sorted(*_arriving(sheet, cover, here, x_, y_))
                for sheet, cover in zip(there, covers, strict=True)
            ]
            values, throughs = [s.value for s in there], [s.through for s in there]
            return _add(sums, parts, values, throughs, own_cover), None

        return jax.lax.scan(jax.checkpoint(add_tap), sums, offsets)

    nothing = Sums((jnp.zeros_like(here.value),) * 3, jnp.zeros_like(here.radius))
    return jax.lax.scan(jax.checkpoint(add_row), nothing, offsets)[0]


def sums(reach: int, sheets: list[Sheet]) -> Sums:
    """The sums over all sprites that reach at most `reach` pixels along an axis.

    Sprites are sorted by the surface of the first sheet.
    """
    taps = sheets[0].radius.size * (2 * reach + 1) ** 2
    return (shifted if taps < FEW_TAPS else _by_tiles)(reach, sheets)


@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _by_tiles(reach: int, sheets: list[Sheet]) -> Sums:
    return sequential_vmap(ft.partial(tiled, reach))(sheets)


@_by_tiles.defjvp
def _by_tiles_jvp(reach, primals, tangents):
    _, dot = jax.jvp(ft.partial(shifted, reach), primals, tangents)
    return _by_tiles(reach, *primals), dot


def tiled(reach: int, sheets: list[Sheet]) -> Sums:
    """The sums, tile by tile.

    Weights of a run of offsets are computed once and kept, for all channels to read: XLA would
    otherwise fuse them into each of the sums.
    """
    height, width = sheets[0].radius.shape
    tall, wide = min(TILE[0], -(-height // 8) * 8), min(TILE[1], -(-width // 8) * 8)
    rows, columns = -(-height // tall), -(-width // wide)
    runs = max(0, -(-(reach - NEAR) // RUN))
    halo = NEAR + runs * RUN
    reaches = ft.reduce(
        jnp.maximum, [_tile_reaches(s.radius, tall, wide, spread=True) for s in sheets]
    )
    sides = ((halo, halo + rows * tall - height), (halo, halo + columns * wide - width))
    sheets = [_padded(sheet, sides) for sheet in sheets]

    def tile(index: Int[Array, ""]) -> Sums:
        top, left = index // columns * tall, index % columns * wide
        theirs = _cut(sheets, top, left, tall + 2 * halo, wide + 2 * halo)
        here = _cut(theirs[0], halo, halo, tall, wide)
        own_area = jnp.pi * here.radius * here.radius
        far = reaches[index]

        def add_row(row, carry):
            sums, lower = carry
            height = row.astype(own_area.dtype) + 0.5
            upper = [segment_integral(sheet.radius, height, False)[0] for sheet in theirs]
            widths = [x - y for x, y in zip(upper, lower, strict=True)]
            own_width = _cut(widths[0], halo, halo, tall, wide)

            def add_side(side, sums):
                y = (1 - 2 * side) * row
                there, spans = _cut((theirs, widths), halo + y, 0, tall, wide + 2 * halo)

                def add_run(run, sums):
                    first = (run - runs) * RUN - NEAR
                    cut = _cut((there, spans), 0, halo + first, tall, wide + RUN - 1)
                    return _add_run(sums, cut, here, own_width, own_area, first, y)

                beyond = _runs(far, row)
                return jax.lax.fori_loop(runs - beyond, runs + beyond + 1, add_run, sums)

            # The middle row is its own mirror image.
            return jax.lax.fori_loop(0, jnp.where(row > 0, 2, 1), add_side, sums), upper

        half = jnp.asarray(0.5, own_area.dtype)
        lower = [-segment_integral(sheet.radius, half, False)[0] for sheet in theirs]
        nothing = Sums((jnp.zeros_like(here.value),) * 3, jnp.zeros_like(here.radius))
        return jax.lax.fori_loop(0, far + 1, add_row, (nothing, lower))[0]

    def assembled(tiles):
        tiles = tiles.reshape(rows, columns, -1, tall, wide).transpose(2, 0, 3, 1, 4)
        return tiles.reshape(-1, rows * tall, columns * wide)[:, :height, :width]

    light, openness = jax.lax.map(tile, jnp.arange(rows * columns))
    return Sums(tuple(map(assembled, light)), assembled(openness)[0])


def _add_run(sums, run, here, own_width, own_area, first, y):
    """What a run of offsets along a row, from `first` on, adds to the sums."""
    tall, wide = own_width.shape
    there, _ = run
    y = y.astype(own_area.dtype)

    def weigh():
        found = []
        for k in range(RUN):
            sheets, widths = _cut(run, 0, k, tall, wide)
            x = (first + k).astype(own_area.dtype)
            found.append(
                [
                    _arriving(sheet, _covered(span, x), here, x, y)
                    for sheet, span in zip(sheets, widths, strict=True)
                ]
            )
        return found

    shapes = jax.eval_shape(weigh)
    zeros = lambda: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    # A branch is a border that XLA fuses nothing across.
    found = jax.lax.cond(y < 1e6, weigh, zeros)
    arriving = [([f[n][0] for f in found], [f[n][1] for f in found]) for n in range(len(there))]
    own = [(first + k).astype(own_area.dtype) for k in range(RUN)]
    own = [_covered(own_width, x) / own_area for x in own]
    at = [slice(k, k + wide) for k in range(RUN)]

    def one_surface(sums):
        front, same, behind = sums.light
        for k in range(RUN):
            for sheet, (weight, _) in zip(there, arriving, strict=True):
                same = same + weight[k][None] * sheet.value[..., at[k]]
        return Sums((front, same, behind), sums.open + sum(own))

    def several(sums):
        for k in range(RUN):
            sums = _add(
                sums,
                [_sorted(weight[k], place[k]) for weight, place in arriving],
                [sheet.value[..., at[k]] for sheet in there],
                [sheet.through[..., at[k]] for sheet in there],
                own[k],
            )
        return sums

    apart = [jnp.abs(p) for _, place in arriving for p in place]
    mixed = ft.reduce(jnp.maximum, apart).max() > 0
    return jax.lax.cond(mixed, several, one_surface, sums)


def _covered(span, x):
    """`_sprites.coverage`, by comparisons that compile to one instruction each."""
    x = jnp.abs(x)
    return _clip(jnp.where(x > 0, span + (0.5 - x), 2 * span), 0, 1)


def _runs(reach, row):
    """How many runs beyond the middle one a disc of that reach covers in a row, to a side."""
    radius = reach.astype(jnp.float32) + POINT_RADIUS
    height = jnp.maximum(row.astype(jnp.float32) - 0.5, 0)
    half_chord = jnp.sqrt(jnp.maximum((radius - height) * (radius + height), 0))
    columns = jnp.ceil(half_chord - 0.5 + 1e-3).astype(int)
    return jnp.maximum(0, (columns - NEAR + RUN - 1) // RUN)
