"""What every filter shares: the map as texels to read, the receivers as places to read them.

A texel outside the map is as far as can be, so that all is lit that is compared with it. A
receiver that is lit whatever the map says reads such texels only. Then no filter has a case to
tell apart: it reads the texels about each place and compares them with its threshold.
"""

import functools as ft
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfx._checks import check, check_map, option, parameter, whole_number
from jaxfx._numerics import absolute, working_dtype
from jaxfx.shadow.receivers import Receivers


Kernel = Literal["box", "tent", "gaussian"]

# Filters of up to so many rows are written out; larger ones loop over rows to compile sooner.
_UNROLLED = 9
# Rows of texels are read in multiples of so many.
LANES = 8
# What a bias that is left out has to spare: texels of slope, for places that are rounded and
# vertices that a rasteriser snaps to a grid; and a share of the depth, for rounding before it.
_SPARE_TEXELS, _SPARE_DEPTH = 1 / 32, 2e-6


class Places(NamedTuple):
    """Receivers as places in the padded map, an array of any one shape.

    `row` and `column` are those of the texel that holds the receiver, `dx` and `dy` lead from
    its centre to the receiver, in texels; what is nearer to the light than `threshold` shadows.
    """

    row: Int[Array, "*place"]
    column: Int[Array, "*place"]
    threshold: Float[Array, "*place"]
    dx: Float[Array, "*place"]
    dy: Float[Array, "*place"]


def checked(
    function: str,
    shadow_map: Any,
    receivers: Any,
    bias: Any,
    slope_bias: Any,
    softness: Any = None,
    *,
    size: Any = 1,
    kernel: Any = "box",
    middle: float | None = None,
) -> tuple[Any, ...]:
    """The five arguments that the filters share, as arrays; `ValueError` names a wrong one.

    Where both biases are left out, the receivers' slope becomes the bias that the filter needs,
    and the slope bias 1. `middle` is for a filter that compares the mean of its texels' depths:
    how many texels its middle may lie from a receiver, along an axis.
    """
    shadow_map = check_map(f"{function}(shadow_map)", shadow_map)
    if not isinstance(receivers, Receivers):
        kind = type(receivers).__name__
        raise ValueError(
            f"`{function}(receivers)` must be what `receivers` gave, got a {kind}."
        )
    fields = [
        parameter(f"{function}(receivers.{name})", field, None)
        for name, field in zip(Receivers._fields, receivers, strict=True)
    ]
    for name, field in zip(Receivers._fields, fields, strict=True):
        if field.shape != fields[0].shape or field.ndim != 2 or 0 in field.shape:
            raise ValueError(
                f"`{function}(receivers)` must hold images of one shape (height, width), "
                f"got {field.shape} for `{name}`."
            )
    size = check_size(f"{function}(size=...)", size)
    option(f"{function}(kernel=...)", kernel, get_args(Kernel))
    if softness is not None:
        softness = parameter(f"{function}(softness=...)", softness)
        check(f"{function}(softness=...)", softness, lambda v: v > 0, "positive, or None")
    receivers = Receivers(*fields)
    if bias is None and slope_bias is None:
        # The farthest texel that is compared; and the terms of a sum that rounds.
        reach, terms = (size / 2, 1) if middle is None else (middle, size)
        needed = _needed_bias(shadow_map.dtype, reach, terms, receivers, softness)
        receivers, slope_bias = receivers._replace(slope=needed), 1.0
    bias, slope_bias = (0.0 if each is None else each for each in (bias, slope_bias))
    bias = parameter(f"{function}(bias=...)", bias)
    slope_bias = parameter(f"{function}(slope_bias=...)", slope_bias)
    for name, number in (("bias", bias), ("slope_bias", slope_bias)):
        check(f"{function}({name}=...)", number, np.isfinite, "finite")
    return shadow_map, receivers, bias, slope_bias, softness


@ft.partial(jax.jit, static_argnums=(0, 1, 2))
def _needed_bias(map_dtype, reach, terms, receivers, softness):
    """How much nearer than a receiver the texels of its own plane may be, in scene units.

    Parallel light meets a plane at a depth that is linear in u and v: `reach` texels away along
    both axes it is `reach * slope` less. A lamp meets it at a depth that is convex in them, and
    so nowhere nearer than that.
    """
    dtype = working_dtype(map_dtype, *(field.dtype for field in receivers))
    z, slope = receivers.z.astype(dtype), receivers.slope.astype(dtype)
    types = (map_dtype, receivers.z.dtype, *terms * (dtype,))
    rounding = sum(float(jnp.finfo(each).eps) for each in types) + _SPARE_DEPTH
    needed = (reach + _SPARE_TEXELS) * slope + rounding * z
    return needed if softness is None else needed + half_width(softness, dtype)


def check_size(name: str, size: Any, least: int = 1) -> int:
    """The width of a filter, odd, in texels; `ValueError` otherwise."""
    is_odd = lambda n: n >= least and n % 2 == 1
    return whole_number(name, size, is_odd, f"an odd number of texels from {least}")


def without_gradient(kernel: Kernel, data: tuple[Any, ...]) -> Any:
    """What `checked` gave, constant where the filter is a step of it."""
    return jax.lax.stop_gradient(data) if is_step(kernel, data[-1]) else data


def is_step(kernel: Kernel, softness: Any) -> bool:
    """Whether a filter has no derivative anywhere."""
    return softness is None and kernel == "box"


def common_dtype(shadow_map: Array, receivers: Receivers) -> jnp.dtype:
    """What a filter computes in, for a map and receivers of any types."""
    return working_dtype(shadow_map.dtype, *(field.dtype for field in receivers))


def pad_map(
    shadow_map: Float[Array, "rows columns"], size: int, dtype: Any
) -> Float[Array, "texels_down texels_across"]:
    """The map with `size` texels that are infinitely far all around, as what is missing is.

    A few more on the right are there to be read, not compared, by vector units.
    """
    known = jnp.where(shadow_map > 0, shadow_map, jnp.inf).astype(dtype)
    widths = ((size, size), (size, size + LANES - 1))
    return jnp.pad(known, widths, constant_values=jnp.inf)


def find_places(
    receivers: Receivers,
    bias: Float[Array, ""],
    slope_bias: Float[Array, ""],
    shape: tuple[int, int],
    size: int,
    dtype: Any,
) -> Places:
    """The receivers in a map of `shape` that `pad_map` padded for filters of `size`."""
    u, v, z, slope = (field.astype(dtype) for field in receivers)
    # One slope that is no number would make the derivative in the slope bias none.
    known = (z > 0) & jnp.isfinite(slope)
    slope = jnp.where(known, slope, 0)
    threshold = z - (bias.astype(dtype) + slope_bias.astype(dtype) * slope)
    threshold = jnp.where(known & (threshold < jnp.inf), threshold, -jnp.inf)

    # A NaN is on neither side of anything, and goes outside of the map.
    reach = size // 2
    u, v = (
        jnp.where(
            each > -reach - 1, jnp.where(each < count + reach, each, count + reach), -reach - 1
        )
        for each, count in ((u, shape[1]), (v, shape[0]))
    )
    x, y = (jax.lax.stop_gradient(jnp.floor(each)) for each in (u, v))
    column, row = (each.astype(jnp.int32) + size for each in (x, y))
    return Places(row, column, threshold, u - x - 0.5, v - y - 0.5)


def lit(
    texel: Float[Array, "*place"],
    threshold: Float[Array, "*place"],
    softness: Float[Array, "..."] | None,
) -> Float[Array, "*place"]:
    """1 where the texel does not shadow, 0 where it does; between the two within `softness`."""
    if softness is None:
        return (texel >= threshold).astype(threshold.dtype)
    half = half_width(softness, threshold.dtype)
    along = (jnp.clip(texel - threshold, -half, half) / half + 1) / 2
    return along * along * (3 - 2 * along)


def everywhere(
    softness: Float[Array, ""] | None, places: Places
) -> Float[Array, "*place"] | None:
    """One a place: its derivative is summed over all places once, and not by each tap."""
    return None if softness is None else jnp.broadcast_to(softness, places.threshold.shape)


def half_width(softness: Float[Array, "..."], dtype: Any) -> Float[Array, "..."]:
    """Half of the depths that are neither lit nor shadowed; never 0, so that it may divide."""
    return jnp.maximum(softness.astype(dtype) / 2, jnp.finfo(dtype).tiny * 1e4)


def weight(offset: Float[Array, "*place"], size: int, kernel: Kernel) -> Float[Array, "*place"]:
    """A tap's weight along one axis, by its centre's distance from the receiver in texels.

    Tent and Gaussian (sigma a sixth of `size`) fall to 0 where the next tap takes over, so that
    they are continuous as the receiver moves.
    """
    half = size / 2
    if kernel == "box":
        return jnp.ones_like(offset)
    if kernel == "tent":
        return jnp.maximum(half - absolute(offset), 0)
    edge = jnp.exp(jnp.asarray(-4.5, offset.dtype))
    return jnp.maximum(jnp.exp(-0.5 * (offset * (3 / half)) ** 2) - edge, 0)


def taps(size: int) -> range:
    """The offsets of a filter's taps along one axis, in texels."""
    return range(-(size // 2), size // 2 + 1)


def sum_rows(row, size: int) -> Any:
    """The sum of `row(dy)` over the filter's rows; `dy` is a Python or a traced integer."""
    if size <= _UNROLLED:
        first, *others = map(row, taps(size))
        for other in others:
            first = jax.tree.map(jnp.add, first, other)
        return first
    zero = jax.tree.map(jnp.zeros_like, jax.eval_shape(row, jnp.asarray(0, jnp.int32)))
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), zero)
    step = jax.checkpoint(lambda total, dy: (jax.tree.map(jnp.add, total, row(dy)), None))
    return jax.lax.scan(step, zero, jnp.asarray(taps(size), jnp.int32))[0]
