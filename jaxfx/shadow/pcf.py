"""Shadow-map comparison: alone, of filtered depths, and filtered itself (percentage closer)."""

import functools as ft

import jax
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber
from jaxfx._meshes import on_any_mesh
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import (
    Kernel,
    compare,
    filtered,
    offsets,
    read_texel,
    set_up,
    sum_rows,
    without_gradient,
)
from jaxfx.shadow.receivers import Receivers


@on_any_mesh
def hard(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
) -> Float[Array, "height width"]:
    """Visibility by one comparison per pixel: 0 or 1, with aliased edges.

    The quickest, for previews.

    **Arguments:**

    - `shadow_map`: rows columns, depth from the light in scene units, inf where there is
      nothing.
    - `receivers`: what `receivers` returned, height width.
    - `bias`: scene units by which a texel must be nearer to shadow.
    - `slope_bias`: texels (pixels of the map); `slope_bias * receivers.slope` is added to the
      bias, so that it grows where light grazes a surface. Where both are left out, they are
      what keeps a plane lit and no more: here half a texel, and what rounding needs. Where one
      is given, the other is 0.

    **Returns:** height width, 0 or 1, in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape or an integer map.

    **Gradient:** zero, for the comparison is a step: use `pcf` with `softness`.

    **Example:** a wall at depth 4, an occluder at depth 2 over the left half of the map:

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> print(shadow.hard(shadow_map, receivers)[4, 2:6])
    [0. 0. 1. 1.]

    A receiver is in shadow where the texel that holds it is nearer to the light than
    `z - bias - slope_bias * slope`, and lit otherwise: at equality, outside the map, behind
    the light, and where the texel is inf or missing (0, negative, NaN).

    Source: Williams 1978, section 3.
    """
    arguments = filter_arguments("hard", shadow_map, receivers, bias, slope_bias)
    return jax.lax.stop_gradient(filtered(*arguments, 1, "box"))


@on_any_mesh
def prefiltered(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
) -> Float[Array, "height width"]:
    """Visibility by comparing with the mean depth of `size` x `size` texels: the wrong order.

    A baseline, kept to show why `pcf` compares first. The result is still 0 or 1, and the mean
    of an occluder's depth and its background's is the depth of neither.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `size`: static; odd, in texels.
    - `bias`, `slope_bias`: as in `hard`, with the same defaults: the
      mean of a plane's depths is that of its middle.

    **Returns:** height width, 0 or 1, in the type of the receivers. A filter that reaches an
    inf or past the map's edge is lit.

    **Raises:** `ValueError` for a wrong shape, an integer map or an even size.

    **Gradient:** zero, as `hard`'s.

    **Example:** the occluder of `hard`'s example casts its shadow one pixel too far:

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> print(shadow.prefiltered(shadow_map, receivers, size=3)[4, 2:6])
    [0. 0. 0. 1.]

    Source: the order of filtering that Reeves, Salesin & Cook 1987, section 3, warn of.
    """
    arguments = (shadow_map, receivers, bias, slope_bias)
    arguments = filter_arguments("prefiltered", *arguments, size=size, mean_reach=0.5)
    return jax.lax.stop_gradient(_prefiltered(*arguments[:4], int(size)))


@ft.partial(jax.jit, static_argnames=("size",))
def _prefiltered(shadow_map, receivers, bias, slope_bias, size):
    texels, places = set_up(shadow_map, receivers, bias, slope_bias, size)

    def row_sum(dy):
        return sum(read_texel(texels, places, dx, dy) for dx in offsets(size))

    mean = sum_rows(row_sum, size) / size**2
    return compare(mean, places.threshold, None).astype(receivers.z.dtype)


@on_any_mesh
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

    Shadow edges become as wide as the filter. With `softness` it can be differentiated in
    everything that moves the receivers; `edge_pcf` gives the same for less.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `hard`.
    - `size`: static; odd, in texels. The filter lies around the texel that holds the receiver.
    - `bias`, `slope_bias`: as in `hard`. Where both are left out, half
      of `size` texels of slope, half of `softness` and what rounding needs: a plane is lit, and
      where an occluder touches it, its shadow starts at most a filter's width away.
    - `softness`: scene units; the comparison rises from 0 to 1 by a smoothstep of this width,
      half on each side of the bias. Left out, it is a step, the limit of a small `softness`.
    - `kernel`: the taps' weights. `"box"`: equal, wherever in its texel the receiver is;
      `"tent"` and `"gaussian"`: centred on the receiver, so that visibility is continuous as
      it moves.

    **Returns:** height width, in [0, 1], in the type of the receivers.

    **Raises:** `ValueError` for a wrong shape, an integer map, an even size, a softness that is
    not positive or an unknown kernel.

    **Gradient:** exact, forward and reverse, with respect to every float, and so to the depth,
    the cameras and the biases behind `receivers`. Of the comparison without `softness`, and of
    the position with the box, it is zero almost everywhere; what an image changes by their
    jumps is missing. The map is data: that an occluder moves with the light is missing too.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> percent = 100 * shadow.pcf(shadow_map, receivers, size=3)
    >>> print(percent[4, 2:6].round())
    [  0.  33.  67. 100.]

    Source: Reeves, Salesin & Cook 1987, section 3; our own: the smooth comparison and the
    weights that follow the receiver.
    """
    arguments = (shadow_map, receivers, bias, slope_bias, softness)
    arguments = filter_arguments("pcf", *arguments, size=size, kernel=kernel)
    return filtered(*without_gradient(kernel, arguments), int(size), kernel)
