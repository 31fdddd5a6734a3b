"""Percentage-closer soft shadows: the filter as wide as the penumbra."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, check, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, clip01, safe_divide
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import compare, offsets, per_place, read_texel, set_up, sum_rows
from jaxfx.shadow.receivers import Receivers


@on_any_mesh
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
    """Soft shadows of a light with an extent: narrow near the occluder, wide far from it.

    Costs two filters of `size`, whatever the penumbra.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `light_camera`: the camera of the map; its scale turns scene units into texels.
    - `size`: static; odd, in texels. A penumbra that is wider is cut to it.
    - `light_size`: the light's diameter, in scene units before a pinhole camera, in radians,
      as seen from the scene, before an orthographic one.
    - `bias`, `slope_bias`, `softness`: as in `pcf`.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size, or a softness or
    light size that is not positive.

    **Gradient:** exact with respect to every float. Without `softness` that of the comparisons
    is zero almost everywhere: what remains is that of the penumbra and of the position in it.

    **Example:** the penumbra of a light that appears one radian wide:

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> soft = shadow.pcss(shadow_map, receivers, light_camera, size=5, light_size=1.0)
    >>> print((100 * soft[4, 2:6]).round())
    [  0.  27.  73. 100.]

    The mean depth `b` of the texels that shadow a receiver at `z`, among `size` x `size`, gives
    the width of the penumbra: `light_size * (z - b) / b` in the scene, by similar triangles.
    The share of lit texels is then taken over a box that wide, centred on the receiver, from
    one texel to `size - 1`. Where occluders lie at several depths, their mean is the depth of
    none, and light leaks below.

    Source: Fernando 2005, percentage-closer soft shadows; the box that follows the receiver
    is our own.
    """
    arguments = (shadow_map, receivers, bias, slope_bias, softness)
    shadow_map, receivers, *rest = filter_arguments("pcss", *arguments, size=size)
    check_camera("pcss(light_camera)", light_camera)
    light_size = parameter("pcss(light_size=...)", light_size)
    check("pcss(light_size=...)", light_size, lambda v: v > 0, "positive")
    return _pcss(shadow_map, receivers, light_camera, *rest, light_size, int(size))


@ft.partial(jax.jit, static_argnames=("size",))
def _pcss(shadow_map, receivers, camera, bias, slope_bias, softness, light_size, size):
    texels, places = set_up(shadow_map, receivers, bias, slope_bias, size)
    dtype = texels.dtype
    softness = per_place(softness, places)

    def occluders(dy: Any):
        """Count and total depth of the texels of a row that shadow."""
        count, total = jnp.zeros_like(places.threshold), jnp.zeros_like(places.threshold)
        for dx in offsets(size):
            texel = read_texel(texels, places, dx, dy)
            shadows = 1 - compare(texel, places.threshold, softness)
            count += shadows
            total += shadows * jnp.where(texel < jnp.inf, texel, 0)
        return count, total

    count, total = sum_rows(occluders, size)
    occluder_depth = safe_divide(total, count)
    z = jnp.where(places.threshold > -jnp.inf, receivers.z.astype(dtype), 1)
    width = penumbra(camera, light_size.astype(dtype), z, occluder_depth)
    width = jnp.where((count > 0) & (occluder_depth > 0), width, 0)
    half_width = jnp.clip(width / 2, 0.5, max(size // 2, 0.5))

    def overlap(offset):
        """The share of a texel that lies in the box, along one axis."""
        return clip01(half_width + 0.5 - absolute(offset))

    weights_across = [overlap(dx - places.dx) for dx in offsets(size)]

    def weighted_row(dy: Any):
        pairs = zip(weights_across, offsets(size), strict=True)
        lit = sum(
            weight * compare(read_texel(texels, places, dx, dy), places.threshold, softness)
            for weight, dx in pairs
        )
        weight = overlap(jnp.asarray(dy).astype(dtype) - places.dy)
        return weight * lit, weight

    lit, weights_down = sum_rows(weighted_row, size)
    return (lit / (weights_down * sum(weights_across))).astype(receivers.z.dtype)


def penumbra(camera, light_size, z, occluder_depth):
    """The width of the penumbra at each receiver, in texels."""
    if isinstance(camera, OrthographicCamera):
        scale = 2 * jnp.tan(light_size / 2) * camera.pixels_per_unit.astype(z.dtype)
        return scale * (z - occluder_depth)
    focal = camera.intrinsics[0, 0].astype(z.dtype)
    return safe_divide(light_size * focal * (z - occluder_depth), z * occluder_depth)
