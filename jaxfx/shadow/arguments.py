"""The arguments that all shadow filters share, and the bias that a filter needs by default.

Used by every filter of this package and by `jaxfx.budget`.
"""

import functools as ft
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx._checks import check, check_map, option, parameter, whole_number
from jaxfx.shadow.compare import Kernel, filter_dtype, half_width
from jaxfx.shadow.receivers import Receivers


# What the default bias adds to the filter's own need. Texels of slope: for positions that are
# rounded, and vertices that a rasteriser snaps to its subpixel grid. Share of the depth: some
# 16 steps of float32, for what was rounded before the comparison. With less, planes shadow
# themselves (tests/shadow/test_bias.py); with more, shadows start farther from their occluder.
_SPARE_TEXELS, _SPARE_DEPTH = 1 / 32, 2e-6


def filter_arguments(
    function: str,
    shadow_map: Any,
    receivers: Any,
    bias: Any,
    slope_bias: Any,
    softness: Any = None,
    *,
    size: Any = 1,
    kernel: Any = "box",
    mean_reach: float | None = None,
) -> tuple[Any, ...]:
    """The map, receivers, both biases and softness as arrays; `ValueError` names a wrong one.

    Where both biases are left out, the receivers' `slope` is replaced by the bias that the
    filter needs, and the slope bias is 1. A filter that compares the mean of its texels'
    depths, not each of them, gives `mean_reach`: how many texels the centre of that mean may
    lie from a receiver, along an axis.
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
    is_odd = lambda n: n >= 1 and n % 2 == 1
    size = whole_number(f"{function}(size=...)", size, is_odd, "an odd number of texels from 1")
    option(f"{function}(kernel=...)", kernel, get_args(Kernel))
    if softness is not None:
        softness = parameter(f"{function}(softness=...)", softness)
        check(f"{function}(softness=...)", softness, lambda v: v > 0, "positive, or None")
    receivers = Receivers(*fields)
    if bias is None and slope_bias is None:
        # The farthest texel that is compared, and the number of terms of a sum that rounds.
        reach, terms = (size / 2, 1) if mean_reach is None else (mean_reach, size)
        needed = _needed_bias(shadow_map.dtype, reach, terms, receivers, softness)
        receivers, slope_bias = receivers._replace(slope=needed), 1.0
    bias, slope_bias = (0.0 if value is None else value for value in (bias, slope_bias))
    bias = parameter(f"{function}(bias=...)", bias)
    slope_bias = parameter(f"{function}(slope_bias=...)", slope_bias)
    for name, number in (("bias", bias), ("slope_bias", slope_bias)):
        check(f"{function}({name}=...)", number, np.isfinite, "finite")
    return shadow_map, receivers, bias, slope_bias, softness


@ft.partial(jax.jit, static_argnums=(0, 1, 2))
def _needed_bias(map_dtype, reach, terms, receivers, softness):
    """How much nearer than a receiver the texels of its own plane may be, in scene units.

    Parallel light meets a plane at a depth that is linear in u and v: `reach` texels away along
    both axes it is `reach * slope` less. A point light meets it at a depth that is convex in
    them, and so nowhere nearer than that.
    """
    dtype = filter_dtype(map_dtype, receivers)
    z, slope = receivers.z.astype(dtype), receivers.slope.astype(dtype)
    rounded = (map_dtype, receivers.z.dtype, *terms * (dtype,))
    rounding = sum(float(jnp.finfo(kind).eps) for kind in rounded) + _SPARE_DEPTH
    needed = (reach + _SPARE_TEXELS) * slope + rounding * z
    return needed if softness is None else needed + half_width(softness, dtype)
