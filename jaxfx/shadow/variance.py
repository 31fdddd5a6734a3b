"""Variance shadow maps: the map filtered once, for all receivers."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._checks import WholeNumber, check, parameter
from jaxfx._numerics import safe_divide
from jaxfx._sampling import bilinear
from jaxfx.shadow import _taps
from jaxfx.shadow.receivers import Receivers


# In lengths of the depth over which the receivers lie; of float32 squares hold such a depth.
_FARTHEST = 1e12


def variance(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    min_variance: Float[ArrayLike, ""] | float = 0.0,
) -> Float[Array, "height width"]:
    """Visibility by an upper bound from the mean and the variance of the filtered depths.

    With `m` and `s` the mean and the standard deviation over `size` x `size` texels, read
    between texels, and `t` the receiver's depth less the bias, it is 1 where `t <= m`, else
    `s**2 / (s**2 + (t - m)**2)`, Chebyshev's bound. The cost of a receiver does not grow with
    `size`. The bound is met where there are two depths; where occluders lie over one another
    it is far above, and light leaks through the lower one.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`. An inf, or what is missing, counts
      as the farthest depth of map and receivers; so does what is 1e12 times as far behind the
      nearest as the receivers.
    - `size`: static; odd, in texels.
    - `bias`, `slope_bias`: scene units and texels, as in `hard`. Where both are left out, what
      rounding takes: a plane's mean depth, read between texels, is the plane's.
    - `min_variance`: scene units squared; the variance is at least this.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size or a negative
    `min_variance`.

    **Gradient:** exact with respect to every float, the farthest depth included.

    Source: Donnelly & Lauritzen 2006, variance shadow maps, equations 4 and 5.
    """
    data = (shadow_map, receivers, bias, slope_bias)
    data = _taps.checked("variance", *data, size=size, middle=0.0)
    least = parameter("variance(min_variance=...)", min_variance)
    check(
        "variance(min_variance=...)", least, lambda v: (v >= 0) & (v < np.inf), "0 or positive"
    )
    return _variance(*data[:4], least, int(size))


@ft.partial(jax.jit, static_argnames=("size",))
def _variance(shadow_map, receivers, bias, slope_bias, least, size):
    dtype = _taps.common_dtype(shadow_map, receivers)
    z = receivers.z.astype(dtype)
    slope = receivers.slope.astype(dtype)
    points = jnp.stack([receivers.u, receivers.v], axis=-1).astype(dtype)
    known = jnp.isfinite(points).all(axis=-1) & jnp.isfinite(z) & jnp.isfinite(slope) & (z > 0)
    z, slope = (jnp.where(known, each, 0) for each in (z, slope))
    threshold = z - (bias.astype(dtype) + slope_bias.astype(dtype) * slope)
    known &= jnp.isfinite(threshold)
    threshold = jnp.where(known, threshold, 0)

    shadow_map = jnp.where(shadow_map > 0, shadow_map.astype(dtype), jnp.inf)
    near, far = _range(shadow_map, threshold, known)
    # Who lies so far behind all receivers lights them, and takes no digits from their squares.
    reach = jnp.max(jnp.where(known, threshold, near)) - near
    far = jnp.minimum(far, near + _FARTHEST * reach)
    scale = jnp.where(far > near, far - near, 1)
    depth = jnp.minimum(shadow_map, far)
    depth = jnp.pad((depth - near) / scale, size + 1, constant_values=(far - near) / scale)
    moments = _mean(jnp.stack([depth, depth * depth], axis=-1), size)

    reach = jnp.asarray(shadow_map.shape[::-1], dtype)[None, None] + size // 2 + 1
    inside = jnp.clip(points, -(size // 2) - 1, reach)
    read = bilinear(moments, jnp.where(known[..., None], inside, -1.0 - size // 2) + size + 1)
    mean = read[..., 0]
    spread = jnp.maximum(read[..., 1] - mean * mean, least.astype(dtype) / scale**2)
    behind = (threshold - near) / scale - mean
    bound = safe_divide(spread, spread + behind * behind)
    return jnp.where(known & (behind > 0), bound, 1).astype(receivers.z.dtype)


def _range(shadow_map, threshold, known):
    """The nearest and the farthest depth that there are; 0 and 0 where there is none."""
    finite = jnp.isfinite(shadow_map)

    def over(reduce, start):
        own = reduce(jnp.where(finite, shadow_map, start))
        other = reduce(jnp.where(known, threshold, start))
        found = reduce(jnp.stack([own, other]))
        return jnp.where(jnp.isfinite(found), found, 0)

    return over(jnp.min, jnp.inf), over(jnp.max, -jnp.inf)


def _mean(image: Float[Array, "height width 2"], size: int) -> Float[Array, "height width 2"]:
    for axis in (0, 1):
        window = [1, 1, 1]
        window[axis] = size
        zero = np.zeros((), image.dtype)  # known when traced, or it has no reverse pass
        image = jax.lax.reduce_window(image, zero, jax.lax.add, window, (1, 1, 1), "SAME")
    return image / size**2
