"""From the texel that a search returned to a point of the surface, with its derivative.

The surface is the column of the texel, or the bilinear patch through the four texel centres
around the ray. At the hit, miss(t) = z(t) - S(x(t), y(t)) = 0, with S the height field. The
implicit function theorem gives dt = -d(miss) / (d miss / dt): the time is constant in value,
and its tangent comes from `miss`, computed from differentiable arguments at that time. No loop
is differentiated.

`height_field` is -1/z (called inverse depth here) for `warp`, and the depth for `intersect`.
All functions work for both, but `is_depth_step`, and thus a `threshold`, needs inverse depth.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfx._loops import fori_loop, scan
from jaxfx._numerics import safe_divide
from jaxfx._platform import by_platform, kept
from jaxfx.reproject._crossings import (
    TOP,
    X_SIDE,
    Y_SIDE,
    Coordinates,
    TexelHit,
    not_before_start,
)


# Newton steps on a patch. With fewer, more rays do not converge, and so keep the point of the
# texel; more cost time.
_NEWTON_STEPS = 4
# Texels. How far from the texel's hit the patch may be met. A patch lies within a texel of its
# centre; larger values accept a hit on another part of the surface.
_REACH_TEXELS = 1.5
# Texels. The length of the last Newton step below which the iteration has converged. Larger
# values accept points off the patch; below the rounding error no ray converges.
_CONVERGED_TEXELS = 1e-2
# A ratio of the slope of `miss` to the size of its terms. Below it a ray grazes the patch, and
# the derivative, divided by the slope, would be mostly rounding error.
_MIN_SLOPE = 1e-3
# The texels of a stencil: how far down and to the right of its first.
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))


class Patch(NamedTuple):
    """An edge-aware bilinear stencil: 2 x 2 texels around each point, and their weights.

    A weight is 0 where the texel lies on another surface. A weight that is 0 only because of
    the position still has a derivative; its texel is skipped only where it is not finite.

    - `row`, `column`: of the texel at the upper left, from -1 on. For a texel outside of the
      map the nearest one inside is read.
    - `weights`: of the texels in the order of `_CORNERS`.
    """

    row: Int[Array, " ray"]
    column: Int[Array, " ray"]
    weights: Float[Array, "4 ray"]

    def read(self, values: Float[Array, "height width"]) -> Float[Array, " ray"]:
        """The weighted mean of a map; 0 where all weights are 0."""
        total = jnp.zeros_like(self.weights[0])
        for (down, right), weight in zip(_CORNERS, self.weights, strict=True):
            texel = _texels(values, self.row + down, self.column + right)
            total = total + weight * _unless_unusable(texel, weight)
        return safe_divide(total, jnp.sum(self.weights, axis=0))

    def read_colors(self, image: Float[Array, "height width channel"]) -> Float[Array, "..."]:
        """The weighted mean of each channel: ray channel."""
        return self.normalized(image.dtype).sum_colors(image)

    def normalized(self, dtype: jnp.dtype) -> "Patch":
        """The stencil with weights whose sum is 1, or that are all 0, in another type."""
        weights = self.weights.astype(dtype)
        weight_sum = jnp.sum(weights, axis=0, keepdims=True)
        weights = safe_divide(weights, jnp.broadcast_to(weight_sum, weights.shape))
        return self._replace(weights=weights)

    def sum_colors(self, image: Float[Array, "height width channel"]) -> Float[Array, "..."]:
        """The weighted sum of each channel: ray channel.

        On a CPU `scan` stores the stencil. Without it, XLA would fuse the search into each
        channel. On an accelerator all is read at once.
        """

        def add(total: Array, texel: Any) -> tuple[Array, None]:
            (down, right), weight = texel
            color = _texels(image, self.row + down, self.column + right)
            weight = jnp.broadcast_to(weight[:, None], color.shape)
            return total + weight * _unless_unusable(color, weight), None

        def in_turn(total: Array, weights: Array) -> Array:
            return scan(add, total, (jnp.asarray(_CORNERS, jnp.int32), weights))[0]

        def at_once(total: Array, weights: Array) -> Array:
            down, right = np.asarray(_CORNERS, np.int32).T[..., None]
            colors = _texels(image, self.row[None] + down, self.column[None] + right)
            weights = jnp.broadcast_to(weights[..., None], colors.shape)
            return total + jnp.sum(weights * _unless_unusable(colors, weights), axis=0)

        weights = self.weights.astype(image.dtype)
        total = jnp.zeros((weights.shape[1], image.shape[2]), image.dtype)
        return by_platform(total, weights, cpu=in_turn, accelerator=at_once)


def _texels(
    values: Float[Array, "height width *channel"],
    row: Int[Array, "..."],
    column: Int[Array, "..."],
) -> Float[Array, "..."]:
    """The texels in these rows and columns, or the nearest ones inside the map."""
    height, width = values.shape[:2]
    place = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
    return values.at[place].get(mode="promise_in_bounds")


def _unless_unusable(texel: Float[Array, "*shape"], weight: Float[Array, "*shape"]) -> Array:
    """The texel, or 0 where it is not finite and has no weight."""
    return jnp.where((weight > 0) | jnp.isfinite(texel), texel, 0)


def edge_aware_patch(
    height_field: Float[Array, "height width"],
    x: Float[Array, " ray"],
    y: Float[Array, " ray"],
    anchor: Float[Array, " ray"],
    threshold: int | float | None,
) -> Patch:
    """The stencil of the four texel centres around each (x, y), within one surface.

    A texel belongs to the surface if no depth step by `threshold` is between it and `anchor`,
    the value of the texel that was hit; `height_field` is then the inverse depth. Without a
    `threshold` every finite texel belongs to it.
    """
    height, width = height_field.shape
    corner_x, corner_y = (jax.lax.stop_gradient(jnp.floor(v - 0.5)) for v in (x, y))
    fraction_x, fraction_y = x - 0.5 - corner_x, y - 0.5 - corner_y
    column = jnp.clip(corner_x, -1, width - 1).astype(jnp.int32)
    row = jnp.clip(corner_y, -1, height - 1).astype(jnp.int32)
    weights = []
    for down, right in _CORNERS:
        value = jax.lax.stop_gradient(_texels(height_field, row + down, column + right))
        is_on_surface = value < jnp.inf
        if threshold is not None:
            is_on_surface = is_on_surface & ~is_depth_step(value, anchor, threshold)
        weight_x = fraction_x if right else 1 - fraction_x
        weight = weight_x * (fraction_y if down else 1 - fraction_y)
        weights.append(jnp.where(is_on_surface, weight, 0))
    return Patch(row, column, jnp.stack(weights))


def is_depth_step(a: Array, b: Array, threshold: int | float) -> Array:
    """Whether two inverse depths -1/z belong to different surfaces.

    They do if (z_far - z_near) / z_near > threshold.
    """
    nearer, farther = jnp.minimum(a, b), jnp.maximum(a, b)
    return farther - nearer > -threshold * farther


class SurfacePoint(NamedTuple):
    """Where each ray meets the surface, differentiable.

    - `position`: a point of the ray: x and y in texels, and the third coordinate.
    - `grazing`: from `texel_point`: whether a ray that hits runs along the top, and so has no
      derivative. From `patch_point`: whether a ray that hits keeps the texel's point, because
      it grazes the patch or Newton's method did not converge.
    """

    position: Coordinates
    grazing: Bool[Array, " ray"]


def texel_point(
    height_field: Array, origin: Coordinates, direction: Coordinates, hit: TexelHit
) -> SurfacePoint:
    """The point where rays meet the top or a side of a texel's column.

    A ray that runs along the top is grazing; its time is constant.
    """
    miss, slope = _texel_miss(height_field, origin, direction, hit)
    grazing = (slope == 0) & hit.mask
    return _implicit_point(
        origin, direction, hit.time, miss, slope, hit.mask & ~grazing, grazing
    )


def _texel_miss(
    height_field: Array, origin: Coordinates, direction: Coordinates, hit: TexelHit
) -> tuple[Float[Array, " ray"], Float[Array, " ray"]]:
    """The function that is 0 at the hit of a top or side, and its derivative along the ray.

    Only its tangent is used. So for a side the constant position of the border is left out. For
    a ray that starts inside the column it is 0: the time does not depend on anything.
    """
    x, y, z = _point_on(origin, direction, hit.time)
    dx, dy, dz = jax.lax.stop_gradient(direction)
    top = hit.read(height_field)
    zeros = [jnp.zeros_like(x)] * 4
    miss, slope = list(zeros), [jnp.ones_like(x)] * 4
    miss[TOP], slope[TOP] = z - jnp.where(jnp.isfinite(top), top, 0), dz
    miss[X_SIDE], slope[X_SIDE] = x, dx
    miss[Y_SIDE], slope[Y_SIDE] = y, dy
    face = hit.face.astype(jnp.int32)
    return (
        jnp.choose(face, miss, mode="clip"),
        jnp.choose(face, slope, mode="clip"),
    )


def patch_point(
    height_field: Array,
    origin: Coordinates,
    direction: Coordinates,
    hit: TexelHit,
    threshold: int | float | None,
    *,
    origin_at_end: bool = False,
) -> SurfacePoint:
    """The point where rays meet the patch through the texel centres, by Newton's method.

    Where the iteration does not converge within `_REACH_TEXELS` of the texel's hit, or the ray
    grazes the patch, the point and its derivative are those of the texel.
    """
    hold = jax.lax.stop_gradient
    held_field, o, d = hold((height_field, origin, direction))
    anchor = hit.read(held_field)

    def patch_miss(height_field, origin, direction, time):
        x, y, z = _point_on(origin, direction, time)
        return z - edge_aware_patch(held_field, x, y, anchor, threshold).read(height_field)

    value_and_slope = lambda time: jax.jvp(
        lambda t: patch_miss(held_field, o, d, t), (time,), (jnp.ones_like(time),)
    )
    speed = jnp.maximum(jnp.abs(d[0]), jnp.abs(d[1]))  # texels per unit of time
    reach = jnp.where(speed > 0, _REACH_TEXELS / jnp.where(speed > 0, speed, 1), jnp.inf)

    def newton(index, state):
        """The time after a step, and the step's length.

        In the last turn the time stays; beside it the slope, or 0 without convergence.
        """
        time, last_move = state
        time, begin = kept((time, hit.time))
        low, high = not_before_start(begin - reach, d[2], origin_at_end), begin + reach
        value, slope = value_and_slope(time)
        move = -value / jnp.where(slope > 0, slope, 1)
        is_last = index == _NEWTON_STEPS
        has_converged = last_move * speed < _CONVERGED_TEXELS
        last_move = jnp.where(slope > 0, jnp.abs(move), jnp.inf)
        moves = (slope > 0) & ~is_last
        time = jnp.where(moves, jnp.clip(time + move, low, high), time)
        return time, jnp.where(is_last, jnp.where(has_converged, slope, 0), last_move)

    # One more turn only computes the slope at the end. A loop's result is stored; outside of
    # the loop, XLA would compute the slope again wherever it is used. The first turn reads the
    # time alone.
    time, slope = fori_loop(0, _NEWTON_STEPS + 1, newton, (hit.time, hit.time))
    terms = jnp.abs(d[2]) + jnp.abs(slope - d[2])
    is_on_patch = (slope > _MIN_SLOPE * terms) & hit.mask
    time = jnp.where(is_on_patch, time, hit.time)
    texel_miss, texel_slope = _texel_miss(height_field, origin, direction, hit)
    miss = patch_miss(height_field, origin, direction, time)
    miss = jnp.where(is_on_patch, miss, texel_miss)
    slope = jnp.where(is_on_patch, slope, texel_slope)
    is_differentiable, grazing = hit.mask & (slope != 0), hit.mask & ~is_on_patch
    return _implicit_point(origin, direction, time, miss, slope, is_differentiable, grazing)


def _implicit_point(
    origin, direction, time, miss, slope, is_differentiable, grazing
) -> SurfacePoint:
    """The position at `time`; its derivative is that of the root of `miss`.

    Where not `is_differentiable`, the time is constant.
    """
    miss = jnp.where(is_differentiable, miss, 0)
    time = _implicit_root(time, miss, jnp.where(is_differentiable, slope, 1))
    return SurfacePoint(_point_on(origin, direction, time), grazing)


def _point_on(origin: Coordinates, direction: Coordinates, time: Array) -> Coordinates:
    """x, y and z of rays at a time."""
    x, y, z = (o + time * d for o, d in zip(origin, direction, strict=True))
    return x, y, z


@jax.custom_jvp
def _implicit_root(time: Array, miss: Array, slope: Array) -> Array:
    """The root of `miss` along a ray. Its value is the given `time`.

    The derivative is the implicit function theorem's: dt = -d(miss) / slope, with `slope` the
    derivative of `miss` along the ray. The value of `miss` is never used.
    """
    return time


@_implicit_root.defjvp
def _implicit_root_jvp(primals, tangents):
    time, _, slope = primals
    return time, -tangents[1] / slope
