"""Percentage-closer soft shadows: the filter as wide as the penumbra."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._checks import WholeNumber, check, parameter
from jaxfx._numerics import absolute, clip01, safe_divide
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.shadow import _taps
from jaxfx.shadow.pcf import read
from jaxfx.shadow.receivers import Receivers


def pcss(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    light_camera: PinholeCamera | OrthographicCamera,
    *,
    size: WholeNumber,
    light_size: Float[ArrayLike, ""] | float,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    softness: Float[ArrayLike, ""] | float | None = None,
) -> Float[Array, "height width"]:
    """Soft shadows of a light with an extent: narrow where a thing stands, wide far from it.

    The mean depth `b` of the texels that shadow a receiver at `z`, among `size` x `size`, gives
    the penumbra: `light_size * (z - b) / b` across in the scene, for similar triangles. The
    share of lit texels is then taken over a box that wide, centred on the receiver, from one
    texel to `size - 1`. Where occluders lie at several depths their mean is that of none, and
    light leaks below; a penumbra wider than the filter is cut.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `light_camera`: what the map was made with; its scale turns scene units into texels.
    - `size`: static; odd, in texels.
    - `light_size`: the light's diameter, in scene units before a pinhole camera, in radians,
      as seen from the scene, before an orthographic one.
    - `bias`, `slope_bias`, `softness`: scene units and texels, as in `pcf`.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size, or a softness or
    light size that is not positive.

    **Gradient:** exact with respect to every float. Without `softness` that of the comparisons
    is zero almost everywhere: what remains is that of the penumbra and of the position in it.

    Source: Fernando 2005, percentage-closer soft shadows; the box that follows the receiver
    is our own.
    """
    data = (shadow_map, receivers, bias, slope_bias, softness)
    shadow_map, receivers, *rest = _taps.checked("pcss", *data, size=size)
    check_camera("pcss(light_camera)", light_camera)
    light_size = parameter("pcss(light_size=...)", light_size)
    check("pcss(light_size=...)", light_size, lambda v: v > 0, "positive")
    return _pcss(shadow_map, receivers, light_camera, *rest, light_size, int(size))


@ft.partial(jax.jit, static_argnames=("size",))
def _pcss(shadow_map, receivers, camera, bias, slope_bias, softness, light_size, size):
    dtype = _taps.common_dtype(shadow_map, receivers)
    texels = _taps.pad_map(shadow_map, size, dtype)
    places = _taps.find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)
    softness = _taps.everywhere(softness, places)

    def blockers(dy: Any):
        count, total = jnp.zeros_like(places.threshold), jnp.zeros_like(places.threshold)
        for dx in _taps.taps(size):
            texel = read(texels, places, dx, dy)
            shadows = 1 - _taps.lit(texel, places.threshold, softness)
            count += shadows
            total += shadows * jnp.where(texel < jnp.inf, texel, 0)
        return count, total

    count, total = _taps.sum_rows(blockers, size)
    mean = safe_divide(total, count)
    z = jnp.where(places.threshold > -jnp.inf, receivers.z.astype(dtype), 1)
    width = _penumbra(camera, light_size.astype(dtype), z, mean)
    width = jnp.where((count > 0) & (mean > 0), width, 0)
    half = jnp.clip(width / 2, 0.5, max(size // 2, 0.5))

    def along(offset):
        """The share of a texel that lies in the box."""
        return clip01(half + 0.5 - absolute(offset))

    across = [along(dx - places.dx) for dx in _taps.taps(size)]

    def row(dy: Any):
        pairs = zip(across, _taps.taps(size), strict=True)
        lit = sum(
            weight * _taps.lit(read(texels, places, dx, dy), places.threshold, softness)
            for weight, dx in pairs
        )
        down = along(jnp.asarray(dy).astype(dtype) - places.dy)
        return down * lit, down

    lit, down = _taps.sum_rows(row, size)
    return (lit / (down * sum(across))).astype(receivers.z.dtype)


def _penumbra(camera, light_size, z, blocker):
    """Its width in texels."""
    if isinstance(camera, OrthographicCamera):
        scale = 2 * jnp.tan(light_size / 2) * camera.pixels_per_unit.astype(z.dtype)
        return scale * (z - blocker)
    focal = camera.intrinsics[0, 0].astype(z.dtype)
    return safe_divide(light_size * focal * (z - blocker), z * blocker)
