"""Variance shadow maps, plain or of warped depths: the map filtered once, for all receivers."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, safe_divide
from jaxfx._sampling import bilinear
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import filter_dtype
from jaxfx.shadow.receivers import Receivers


# In multiples of the range of the receivers' depths. Texels farther behind count as this far:
# their squares, in float32, would otherwise leave no digits for the receivers' depths, and
# above about 1e19 overflow.
_FARTHEST = 1e12
# No unit: the exponents that a type can hold. A squared warped depth lies between exp(-c) and
# exp(c), and `size`**2 of them are added: float32 ends at exp(88.7), float64 at exp(709). With
# larger ones sums overflow, and what is far from the light is lit. Below 1 a warp is nearly a
# straight line, and the difference of its moments loses digits.
_LEAST_EXPONENT, _MOST_EXPONENT = 1.0, {"float32": 80.0, "float64": 640.0}


@on_any_mesh
def variance(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    min_variance: Float[ArrayLike, ""] | float = 0.0,
    exponents: Float[ArrayLike, "2"] | tuple[Number, Number] | None = None,
) -> Float[Array, "height width"]:
    """Visibility by an upper bound from the mean and the variance of the filtered depths.

    The cost per receiver does not grow with `size`. The bound is exact where there are two
    depths; where occluders overlap it is far too high, and light leaks through the lower one.
    `exponents` warp the depths first, and close most of that leak.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`. An inf, or what is missing, counts
      as the farthest depth of map and receivers; so does what is 1e12 times as far behind the
      nearest as the receivers.
    - `size`: static; odd, in texels.
    - `bias`, `slope_bias`: as in `hard`. Where both are left out, what
      rounding needs: a plane's mean depth, read between texels, is the plane's.
    - `min_variance`: scene units squared; the variance is at least this.
    - `exponents`: 2, no unit; c and d of the warped depths exp(c t) and -exp(-d t), where t
      goes from -1/2 at the nearest depth of map and receivers to 1/2 at the farthest. From 1 to
      80 in float32, to 640 in float64; traced ones beyond count as the limit. (80, 10) is a
      usual choice. None: no warp.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size, a negative
    `min_variance`, or exponents out of range.

    **Gradient:** exact with respect to every float, the farthest depth included. With respect
    to exponents beyond their limits it is zero.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> percent = 100 * shadow.variance(shadow_map, receivers, size=3)
    >>> print(percent[4, 2:6].round())
    [  0.  33.  67. 100.]

    With `m` and `s` the mean and the standard deviation over `size` x `size` texels, read
    between texels, and `t` the receiver's depth less the bias, the visibility is 1 where
    `t <= m`, else `s**2 / (s**2 + (t - m)**2)`, Chebyshev's bound.

    With `exponents` it is the smaller of the bounds of two warped depths. Under the first warp
    occluders far above a receiver are nearly at one depth: the leak through the lower one falls
    by exp(-2 c g), where g is its distance from the receiver as a share of the range. The
    second weighs near occluders most, and so holds where the filter also sees what lies behind
    the receiver. An occluder within about 1 / c of the range still leaks. On a surface that is
    steep as the light sees it the second darkens a little, by (d * s / range)**2 / 4. Where the
    map shows something far behind the scene, the range is large and exponents help less.

    Source: Donnelly & Lauritzen 2006, variance shadow maps, equations 4 and 5; Lauritzen &
    McCool 2008, section 4.2, the two warps. Depths about the middle of the range, which doubles
    the exponents that float32 holds, are our own.
    """
    arguments = (shadow_map, receivers, bias, slope_bias)
    arguments = filter_arguments("variance", *arguments, size=size, mean_reach=0.0)
    name = "variance(min_variance=...)"
    least_variance = parameter(name, min_variance)
    check(name, least_variance, lambda v: (v >= 0) & (v < np.inf), "0 or positive")
    if exponents is not None:
        name = "variance(exponents=...)"
        exponents = parameter(name, exponents, (2,))
        least, most = _limits(filter_dtype(arguments[0].dtype, arguments[1]))
        is_inside = lambda v: (v >= least) & (v <= most)
        check(name, exponents, is_inside, f"in [{least:g}, {most:g}]")
    return _variance(*arguments[:4], least_variance, exponents, int(size))


@ft.partial(jax.jit, static_argnames=("size",))
def _variance(shadow_map, receivers, bias, slope_bias, least_variance, exponents, size):
    dtype = filter_dtype(shadow_map.dtype, receivers)
    z = receivers.z.astype(dtype)
    slope = receivers.slope.astype(dtype)
    points = jnp.stack([receivers.u, receivers.v], axis=-1).astype(dtype)
    is_valid = jnp.isfinite(points).all(axis=-1) & jnp.isfinite(z) & jnp.isfinite(slope)
    is_valid &= z > 0
    z, slope = (jnp.where(is_valid, field, 0) for field in (z, slope))
    threshold = z - (bias.astype(dtype) + slope_bias.astype(dtype) * slope)
    is_valid &= jnp.isfinite(threshold)
    threshold = jnp.where(is_valid, threshold, 0)

    shadow_map = jnp.where(shadow_map > 0, shadow_map.astype(dtype), jnp.inf)
    near, far = _depth_range(shadow_map, threshold, is_valid)
    # A texel that far behind all receivers lights them, but its square would take their digits.
    receiver_range = jnp.max(jnp.where(is_valid, threshold, near)) - near
    far = jnp.minimum(far, near + _FARTHEST * receiver_range)
    scale = jnp.where(far > near, far - near, 1)
    depth = jnp.minimum(shadow_map, far)
    # From here on in units of the range, 0 at the nearest depth.
    depth = jnp.pad((depth - near) / scale, size + 1, constant_values=(far - near) / scale)
    behind, least = (threshold - near) / scale, least_variance.astype(dtype) / scale**2
    warps, rounding = [lambda depth: depth], 0.0
    if exponents is not None:
        # Of a mean of equal warped depths, which would shadow its own depth by this.
        rounding = (2 * size + 8) * float(jnp.finfo(dtype).eps)
        first, second = jnp.clip(exponents.astype(dtype), *_limits(dtype))
        warps = [
            lambda depth: jnp.exp(first * (depth - 0.5)),
            lambda depth: -jnp.exp(-second * (depth - 0.5)),
        ]
    moments = [moment for warp in warps for moment in (warp(depth), warp(depth) ** 2)]
    moments = _box_mean(jnp.stack(moments, axis=-1), size)

    border = jnp.asarray(shadow_map.shape[::-1], dtype)[None, None] + size // 2 + 1
    inside = jnp.clip(points, -(size // 2) - 1, border)
    pixels = jnp.where(is_valid[..., None], inside, -1.0 - size // 2) + size + 1
    sampled = bilinear(moments, pixels)
    visibility = jnp.ones_like(z)
    for k, warp in enumerate(warps):
        # A small deviation is stretched by the slope of the warp.
        receiver, stretch = jax.jvp(warp, (behind,), (jnp.ones_like(behind),))
        mean, mean_square = sampled[..., 2 * k], sampled[..., 2 * k + 1]
        # The bound is a ratio: in this unit float32 holds the squares in its derivative, too.
        unit = jax.lax.stop_gradient(jnp.maximum(absolute(receiver), absolute(mean)))
        unit = jnp.where(unit > 0, unit, 1)
        receiver, mean, stretch = receiver / unit, mean / unit, stretch / unit
        spread = mean_square / unit / unit - mean * mean
        squared_deviation = jnp.maximum(spread, least * stretch**2)
        past = receiver - mean
        bound = safe_divide(squared_deviation, squared_deviation + past * past)
        visibility = jnp.minimum(visibility, jnp.where(is_valid & (past > rounding), bound, 1))
    return visibility.astype(receivers.z.dtype)


def _limits(dtype: jnp.dtype) -> tuple[float, float]:
    """The least and the largest exponent of a type."""
    return _LEAST_EXPONENT, _MOST_EXPONENT[dtype.name]


def _depth_range(
    shadow_map: Float[Array, "rows columns"],
    threshold: Float[Array, "height width"],
    is_valid: Bool[Array, "height width"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The nearest and the farthest finite depth of map and receivers; 0 where there is none."""
    finite = jnp.isfinite(shadow_map)

    def over(reduce, start):
        of_map = reduce(jnp.where(finite, shadow_map, start))
        of_receivers = reduce(jnp.where(is_valid, threshold, start))
        extreme = reduce(jnp.stack([of_map, of_receivers]))
        return jnp.where(jnp.isfinite(extreme), extreme, 0)

    return over(jnp.min, jnp.inf), over(jnp.max, -jnp.inf)


def _box_mean(
    image: Float[Array, "height width moment"], size: int
) -> Float[Array, "height width moment"]:
    """The mean over `size` x `size` pixels; outside the image counts as 0."""
    for axis in (0, 1):
        window = [1, 1, 1]
        window[axis] = size
        # A NumPy scalar is known when traced; with a traced one there is no reverse pass.
        zero = np.zeros((), image.dtype)
        image = jax.lax.reduce_window(image, zero, jax.lax.add, window, (1, 1, 1), "SAME")
    return image / size**2
