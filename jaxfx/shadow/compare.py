"""Comparisons of shadow-map texels with receivers, and their weighted means.

`hard`, `pcf`, `edge_pcf` and `pcss` are made of these, and `jaxfx.budget` uses them.

`set_up` pads the map with texels at infinite depth, which shadow nothing, and turns receivers
into places in it. A receiver that is lit in any case (behind the light, outside the map, not
finite) gets a place among those texels or a threshold of -inf. So filters need no special
cases: they read the texels around each place and compare them with its threshold.
"""

import functools as ft
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import scan
from jaxfx._numerics import absolute, working_dtype
from jaxfx._platform import kept
from jaxfx._xla import apart
from jaxfx.shadow.receivers import Receivers


Kernel = Literal["box", "tent", "gaussian"]
Texels = Float[Array, "texels_down texels_across"]

# Rows of taps. Filters of up to this many are unrolled; larger ones scan over rows, which
# compiles sooner. The values are the same.
_UNROLLED_ROWS = 9
# Rows of taps in one kernel of an accelerator. The time to compile a kernel grows with the
# square of its taps. A wrong value costs time only.
_ROWS_OF_A_KERNEL = 3
# Texels. Rows of a window are read in multiples of this, the float32 numbers in a vector
# register of 32 bytes. It matters for speed alone.
_LANES = 8
# Texels. Hard box filters from this size on are counted in whole windows; smaller ones are read
# tap by tap. It matters for speed alone.
_LEAST_WINDOW = 7


class Places(NamedTuple):
    """Receivers as places in the padded map. All fields have the same shape, whatever it is.

    - `row`, `column`: of the texel that holds the receiver.
    - `threshold`: scene units; a texel that is nearer to the light than this shadows.
    - `dx`, `dy`: texels, from the centre of that texel to the receiver.
    """

    row: Int[Array, "*place"]
    column: Int[Array, "*place"]
    threshold: Float[Array, "*place"]
    dx: Float[Array, "*place"]
    dy: Float[Array, "*place"]


def filter_dtype(map_dtype: Any, receivers: Receivers) -> jnp.dtype:
    """The type in which a filter computes."""
    return working_dtype(map_dtype, *(field.dtype for field in receivers))


def set_up(
    shadow_map: Float[Array, "rows columns"],
    receivers: Receivers,
    bias: Float[Array, ""],
    slope_bias: Float[Array, ""],
    size: int,
) -> tuple[Texels, Places]:
    """The padded map and the receivers' places in it, for filters up to `size` texels wide."""
    dtype = filter_dtype(shadow_map.dtype, receivers)
    texels = pad_map(shadow_map, size, dtype)
    return texels, find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)


def pad_map(shadow_map: Float[Array, "rows columns"], size: int, dtype: Any) -> Texels:
    """The map with a border of `size` texels at inf; missing texels are inf as well.

    `_LANES - 1` more on the right allow windows to be read in whole vectors near the right
    border; they are not compared.
    """
    depth = jnp.where(shadow_map > 0, shadow_map, jnp.inf).astype(dtype)
    widths = ((size, size), (size, size + _LANES - 1))
    return jnp.pad(depth, widths, constant_values=jnp.inf)


def find_places(
    receivers: Receivers,
    bias: Float[Array, ""],
    slope_bias: Float[Array, ""],
    shape: tuple[int, ...],
    size: int,
    dtype: Any,
) -> Places:
    """The receivers' places in a map of `shape` that `pad_map` padded for `size`."""
    u, v, z, slope = (field.astype(dtype) for field in receivers)
    threshold = z - (bias.astype(dtype) + _slope_offset(slope_bias.astype(dtype), slope))
    # A slope that is not finite leads to NaN or to an infinity of either sign: lit, as by -inf.
    threshold = jnp.where((z > 0) & (threshold < jnp.inf), threshold, -jnp.inf)

    # Receivers outside the map, and NaNs, which no comparison holds for, go to its border.
    reach = size // 2
    u, v = (
        jnp.where(x > -reach - 1, jnp.where(x < count + reach, x, count + reach), -reach - 1)
        for x, count in ((u, shape[1]), (v, shape[0]))
    )
    left, top = (jax.lax.stop_gradient(jnp.floor(x)) for x in (u, v))
    column, row = (x.astype(jnp.int32) + size for x in (left, top))
    return Places(row, column, threshold, u - left - 0.5, v - top - 0.5)


@jax.custom_jvp
def _slope_offset(
    slope_bias: Float[Array, ""], slope: Float[Array, "*place"]
) -> Float[Array, "*place"]:
    """Bias by a receiver's slope, scene units.

    A slope that is not finite adds nothing to the derivative in `slope_bias`, which stays
    finite. The value needs no such check: XLA would repeat it for every tap, for 7 % of the
    time of a filter of 7 x 7 texels.
    """
    return slope_bias * slope


@_slope_offset.defjvp
def _(primals, tangents):
    slope_bias, slope = primals
    slope_bias_dot, slope_dot = tangents
    finite = jnp.where(jnp.isfinite(slope), slope, 0)
    return slope_bias * slope, slope_bias_dot * finite + slope_bias * slope_dot


@ft.partial(jax.jit, static_argnames=("size", "kernel"))
def filtered(shadow_map, receivers, bias, slope_bias, softness, size, kernel):
    """`pcf` in every pixel, of arguments that `filter_arguments` has checked."""
    texels, places = set_up(shadow_map, receivers, bias, slope_bias, size)
    result = mean_comparison(texels, places, softness, size, kernel).astype(receivers.z.dtype)
    if _is_step(kernel, softness):
        return result
    # `apart` stores the cotangent of the result, which every tap's derivative would otherwise
    # compute again.
    return apart(result, lambda: result)


def without_gradient(kernel: Kernel, arguments: tuple[Any, ...]) -> Any:
    """The arguments, held constant if the filter's derivative is 0 everywhere.

    They are the map, receivers, bias, slope bias and, last, the softness.
    """
    return jax.lax.stop_gradient(arguments) if _is_step(kernel, arguments[-1]) else arguments


def _is_step(kernel: Kernel, softness: Any) -> bool:
    """Whether the filter is piecewise constant in all of its arguments."""
    return softness is None and kernel == "box"


def mean_comparison(
    texels: Texels,
    places: Places,
    softness: Float[Array, ""] | None,
    size: int,
    kernel: Kernel,
) -> Float[Array, "*place"]:
    """The weighted mean of `compare` over the `size` x `size` taps around each place."""
    if kernel == "box" and softness is None and size >= _LEAST_WINDOW:
        return _lit_share(texels, places, size)
    softness = per_place(softness, places)

    def compared(dx, dy):
        return compare(read_texel(texels, places, dx, dy), places.threshold, softness)

    if kernel == "box" or size == 1:

        def row_sum(dy):
            return sum(compared(dx, dy) for dx in offsets(size))

        return _box_mean(sum_rows(row_sum, size), size)

    weights_across = [tap_weight(dx - places.dx, size, kernel) for dx in offsets(size)]

    def weighted_row(dy):
        pairs = zip(weights_across, offsets(size), strict=True)
        weighted = sum(weight * compared(dx, dy) for weight, dx in pairs)
        down = jnp.asarray(dy).astype(places.dy.dtype) - places.dy
        weight = tap_weight(down, size, kernel)
        return weight * weighted, weight

    total, weights_down = sum_rows(weighted_row, size)
    mean = total / (weights_down * sum(weights_across))
    return _one_where(mean > 1, mean)  # Rounding can make it exceed 1.


def compare(
    texel: Float[Array, "*place"],
    threshold: Float[Array, "*place"],
    softness: Float[Array, "..."] | None,
) -> Float[Array, "*place"]:
    """Visibility by one texel: 0 where it is nearer to the light than `threshold`, 1 elsewhere.

    With `softness` it rises by a smoothstep of that width, centred on the threshold.
    """
    if softness is None:
        return (texel >= threshold).astype(threshold.dtype)
    half = half_width(softness, threshold.dtype)
    along = (jnp.clip(texel - threshold, -half, half) / half + 1) / 2
    return along * along * (3 - 2 * along)


def half_width(softness: Float[Array, "..."], dtype: Any) -> Float[Array, "..."]:
    """Half the width of a soft comparison, scene units; above 0, so that it can divide."""
    return jnp.maximum(softness.astype(dtype) / 2, jnp.finfo(dtype).tiny * 1e4)


def per_place(
    softness: Float[Array, ""] | None, places: Places
) -> Float[Array, "*place"] | None:
    """`softness` broadcast to all places, once.

    Its derivative is then summed over places once, instead of once for each tap.
    """
    return None if softness is None else jnp.broadcast_to(softness, places.threshold.shape)


def read_texel(texels: Texels, places: Places, dx: int, dy: Any) -> Float[Array, "*place"]:
    """The texel `dx` columns and `dy` rows from the one that holds each place."""
    index = (places.row + dy) * texels.shape[1] + (places.column + dx)
    return texels.reshape(-1).at[index].get(mode="promise_in_bounds")


def tap_weight(
    offset: Float[Array, "*place"], size: int, kernel: Kernel
) -> Float[Array, "*place"]:
    """The weight of a tap along one axis; `offset` is in texels, from receiver to tap.

    Tent and Gaussian (standard deviation `size / 6`) are 0 at half a filter's width, where the
    next tap enters on the other side, so they are continuous as the receiver moves.
    """
    half = size / 2
    if kernel == "box":
        return jnp.ones_like(offset)
    if kernel == "tent":
        return jnp.maximum(half - absolute(offset), 0)
    # The Gaussian at half the filter's width, which is 3 standard deviations: exp(-3**2 / 2).
    edge = jnp.exp(jnp.asarray(-4.5, offset.dtype))
    return jnp.maximum(jnp.exp(-0.5 * (offset * (3 / half)) ** 2) - edge, 0)


def offsets(size: int) -> range:
    """The offsets of a filter's taps along one axis, in texels."""
    return range(-(size // 2), size // 2 + 1)


def sum_rows(row: Any, size: int) -> Any:
    """The sum of `row(dy)` over the filter's rows; `dy` is a Python or a traced integer."""
    if size <= _UNROLLED_ROWS:
        total, *others = map(row, offsets(size))
        for count, other in enumerate(others, start=2):
            total = jax.tree.map(jnp.add, total, other)
            if count % _ROWS_OF_A_KERNEL == 0:
                total = kept(total)
        return total
    zero = jax.tree.map(jnp.zeros_like, jax.eval_shape(row, jnp.asarray(0, jnp.int32)))
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), zero)
    step = jax.checkpoint(lambda total, dy: (jax.tree.map(jnp.add, total, row(dy)), None))
    return scan(step, zero, jnp.asarray(offsets(size), jnp.int32))[0]


def _lit_share(texels: Texels, places: Places, size: int) -> Float[Array, "*place"]:
    """The share of lit taps; whole windows are gathered, whose rows are read as vectors."""
    shape = places.row.shape
    row, column, threshold = (field.reshape(-1) for field in places[:3])
    padded_width = -(-size // _LANES) * _LANES
    windows = jax.lax.GatherDimensionNumbers(
        offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1)
    )
    corner = jnp.stack([row, column], axis=-1) - size // 2
    window = jax.lax.gather(
        texels, corner, windows, (size, padded_width), mode="promise_in_bounds"
    )
    is_tap = (jnp.arange(padded_width) < size)[None, None]
    is_lit = (window >= threshold[:, None, None]) & is_tap
    count = jnp.sum(is_lit, axis=(1, 2), dtype=jnp.int32)
    return _box_mean(count.astype(threshold.dtype), size).reshape(shape)


def _box_mean(total: Float[Array, "*place"], size: int) -> Float[Array, "*place"]:
    """`total / size**2`; exactly 1 where all taps are lit, however XLA rounds the division."""
    return _one_where(total == size**2, total / size**2)


def _one_where(is_one: Bool[Array, "*place"], mean: Float[Array, "*place"]) -> Array:
    """`mean`, but 1 where `is_one`, with the derivative of `mean` everywhere.

    Written as a sum, because the derivative of a `where` reads `is_one`, and with it `total`,
    which each tap would then sum up again.
    """
    return mean + jax.lax.stop_gradient(jnp.where(is_one, 1 - mean, 0))
