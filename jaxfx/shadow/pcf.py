"""Shadow-map comparison: alone, after filtering, and before it (percentage closer)."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num

from jaxfx._checks import WholeNumber
from jaxfx._filter import apart
from jaxfx.shadow import _taps
from jaxfx.shadow._taps import Kernel, Places
from jaxfx.shadow.receivers import Receivers


Texels = Float[Array, "texels_down texels_across"]

# Smaller filters are read tap by tap.
_LEAST_WINDOW = 7


def hard(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
) -> Float[Array, "height width"]:
    """Visibility by the comparison alone: 0 or 1, with aliased edges.

    A receiver is in shadow where the texel that holds it is nearer to the light than
    `z - bias - slope_bias * slope`, and lit otherwise: at equality, outside the map, behind
    the light, and where the texel is inf or missing (0, negative, NaN).

    **Arguments:**

    - `shadow_map`: rows columns, depth from the light in scene units, inf where there is
      nothing.
    - `receivers`: what `receivers` returned, height width.
    - `bias`: scene units by which a texel must be nearer to shadow.
    - `slope_bias`: pixels of the map by which the same grows where light grazes: so many times
      the change of depth from one to the next, the receivers' `slope`. Where both are left out,
      they are what keeps a plane lit and no more: here half a pixel, and what rounding takes.
      Where one is given, the other is 0.

    **Returns:** height width, 0 or 1, in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape or an integer map.

    **Gradient:** zero, for the comparison is a step: use `pcf` with `softness`.

    Source: Williams 1978, section 3.
    """
    data = _taps.checked("hard", shadow_map, receivers, bias, slope_bias)
    return jax.lax.stop_gradient(filtered(*data, 1, "box"))


def prefiltered(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
) -> Float[Array, "height width"]:
    """Visibility by comparing with the mean depth of `size` x `size` texels: the wrong order.

    It is still 0 or 1, and the mean of an occluder's depth and its background's is that of
    neither. Kept to show so. A filter that reaches an inf or past the map's edge is lit.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `size`: static; odd, in texels.
    - `bias`, `slope_bias`: scene units and texels, as in `hard`, whose defaults serve: the mean
      of a plane's depths is that of its middle.

    **Returns:** height width, 0 or 1, in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map or an even size.

    **Gradient:** zero, as `hard`'s.

    Source: the order of filtering that Reeves, Salesin & Cook 1987, section 3, warn of.
    """
    data = (shadow_map, receivers, bias, slope_bias)
    data = _taps.checked("prefiltered", *data, size=size, middle=0.5)
    size = int(size)
    return jax.lax.stop_gradient(_prefiltered(*data[:4], size))


@ft.partial(jax.jit, static_argnames=("size",))
def _prefiltered(shadow_map, receivers, bias, slope_bias, size):
    dtype = _taps.common_dtype(shadow_map, receivers)
    texels = _taps.pad_map(shadow_map, size, dtype)
    places = _taps.find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)

    def row(dy):
        return sum(read(texels, places, dx, dy) for dx in _taps.taps(size))

    mean = _taps.sum_rows(row, size) / size**2
    return _taps.lit(mean, places.threshold, None).astype(receivers.z.dtype)


def pcf(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    softness: Float[ArrayLike, ""] | float | None = None,
    kernel: Kernel = "box",
) -> Float[Array, "height width"]:
    """Percentage-closer filtering: the share of `size` x `size` texels that do not shadow.

    The filter lies about the texel that holds the receiver. Each texel is compared as in
    `hard`, then the comparisons are averaged.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `size`: static; odd, in texels.
    - `bias`, `slope_bias`: scene units and texels, as in `hard`. Where both are left out, half
      of `size` texels of slope, half of `softness` and what rounding takes: a plane is lit, and
      a shadow loses its foot, no wider than the filter, where an occluder touches it.
    - `softness`: scene units; the comparison goes from 0 to 1 by a smoothstep this wide, half
      on each side of the bias. Left out, it is a step, to which it tends.
    - `kernel`: the weights: `"box"`, all the same, wherever in its texel the receiver is; or
      `"tent"` and `"gaussian"`, centred on the receiver, so that visibility is continuous as
      it moves.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size, a softness that is
    not positive or an unknown kernel.

    **Gradient:** exact, forward and reverse, with respect to every float, and so to the depth,
    the cameras and the biases behind `receivers`. Of the comparison without `softness`, and of
    the position with the box, it is zero almost everywhere; what a picture loses by their
    jumps is missing. The map is data: that an occluder moves with the light is missing too.

    Source: Reeves, Salesin & Cook 1987, section 3; our own: the smooth comparison and the
    weights that follow the receiver.
    """
    data = (shadow_map, receivers, bias, slope_bias, softness)
    data = _taps.checked("pcf", *data, size=size, kernel=kernel)
    return filtered(*_taps.without_gradient(kernel, data), int(size), kernel)


@ft.partial(jax.jit, static_argnames=("size", "kernel"))
def filtered(shadow_map, receivers, bias, slope_bias, softness, size, kernel):
    """`pcf` of checked arguments."""
    dtype = _taps.common_dtype(shadow_map, receivers)
    texels = _taps.pad_map(shadow_map, size, dtype)
    places = _taps.find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)
    result = average(texels, places, softness, size, kernel).astype(receivers.z.dtype)
    if _taps.is_step(kernel, softness):
        return result
    # In memory, so that no tap's derivative adds up anew what a loss asks of the result.
    return apart(result, lambda: result)


def average(
    texels: Texels,
    places: Places,
    softness: Float[Array, ""] | None,
    size: int,
    kernel: Kernel,
) -> Float[Array, "*place"]:
    """The mean comparison of the taps about each place."""
    if kernel == "box" and softness is None and size >= _LEAST_WINDOW:
        return _share(texels, places, size)
    softness = _taps.everywhere(softness, places)

    def compared(dx, dy):
        return _taps.lit(read(texels, places, dx, dy), places.threshold, softness)

    if kernel == "box" or size == 1:

        def count(dy):
            return sum(compared(dx, dy) for dx in _taps.taps(size))

        return _mean(_taps.sum_rows(count, size), size)

    across = [_taps.weight(dx - places.dx, size, kernel) for dx in _taps.taps(size)]

    def row(dy):
        pairs = zip(across, _taps.taps(size), strict=True)
        weighted = sum(weight * compared(dx, dy) for weight, dx in pairs)
        down = jnp.asarray(dy).astype(places.dy.dtype) - places.dy
        weight = _taps.weight(down, size, kernel)
        return weight * weighted, weight

    total, down = _taps.sum_rows(row, size)
    share = total / (down * sum(across))
    return _one_where(share > 1, share)  # by rounding


def read(texels: Texels, places: Places, dx: int, dy: Any) -> Float[Array, "*place"]:
    """The texel so far from the one that holds each place."""
    index = (places.row + dy) * texels.shape[1] + (places.column + dx)
    return texels.reshape(-1).at[index].get(mode="promise_in_bounds")


def _share(texels: Texels, places: Places, size: int) -> Float[Array, "*place"]:
    """The share of lit taps, counted in whole windows: their rows are read as vectors."""
    shape = places.row.shape
    row, column, threshold = (each.reshape(-1) for each in places[:3])
    wide = -(-size // _taps.LANES) * _taps.LANES
    whole = jax.lax.GatherDimensionNumbers(
        offset_dims=(1, 2), collapsed_slice_dims=(), start_index_map=(0, 1)
    )
    corner = jnp.stack([row, column], axis=-1) - size // 2
    window = jax.lax.gather(texels, corner, whole, (size, wide), mode="promise_in_bounds")
    is_lit = (window >= threshold[:, None, None]) & (jnp.arange(wide) < size)[None, None]
    count = jnp.sum(is_lit, axis=(1, 2), dtype=jnp.int32)
    return _mean(count.astype(threshold.dtype), size).reshape(shape)


def _mean(total: Float[Array, "*place"], size: int) -> Float[Array, "*place"]:
    """The total over `size**2`; of all that can be, 1, whatever XLA makes of a division."""
    return _one_where(total == size**2, total / size**2)


def _one_where(all_lit: Bool[Array, "*place"], share: Float[Array, "*place"]) -> Array:
    """As a sum: its derivative asks nothing of the total, which each tap would add up anew."""
    return share + jax.lax.stop_gradient(jnp.where(all_lit, 1 - share, 0))
