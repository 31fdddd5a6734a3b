"""The residual of `fit.camera`: an image reprojected to a pose, less the photograph."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import safe_divide
from jaxfx._sampling import bilinear, nearest, pixel_centers
from jaxfx.camera import PinholeCamera
from jaxfx.fit._exposure import exposure_between
from jaxfx.fit._robust import huber
from jaxfx.reproject.view import trace_pixels


# The margin of an image that is not compared, in pixels: a blur there lacks what is outside.
# The last blur has a sigma of a pixel: 2 pixels are its two standard deviations.
_FRAME = 2


class Views(NamedTuple):
    """A photograph with its depth, if any, a source (an image with depth), and their cameras.

    All at the size at which they are compared.

    - `reference`, `reference_depth`: the photograph.
    - `image`, `depth`, `source`: the source and its camera.
    - `start`: the photograph's camera, where the search starts.
    """

    reference: Float[Array, "rows columns channel"]
    reference_depth: Float[Array, "rows columns"] | None
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    source: PinholeCamera
    start: PinholeCamera


class Comparison(NamedTuple):
    """The reprojected source less the reference, per pixel, after gain and offset.

    - `deviations`: the differences of the channels and, where the reference has its own depth,
      the relative difference of depths, in standard deviations of the noise.
    - `counts`: 1 where a pixel is compared, 0 elsewhere.
    - `gain`, `offset`: a ratio and units of radiance.
    - `contrast`: mean square of the reference about its mean, in squared units of radiance.
    """

    deviations: Float[Array, "rows columns value"]
    counts: Float[Array, "rows columns"]
    gain: Float[Array, " channel"]
    offset: Float[Array, " channel"]
    contrast: Float[Array, ""]


class Residual(eqx.Module):
    """The reprojected image less the reference, where both are known, as a function of a twist.

    A twist is six numbers: a translation and a rotation of the start's camera in its own axes.

    - `views`: the images, blurred alike, their depths and cameras.
    - `clear`: the texels of the source that may be looked at: no step in depth is near.
    - `unit`: the unit of each part of a twist: scene units, then radians.
    - `scale`: standard deviations of noise, in units of radiance and of relative depth.
    - `exposure`: whether gain and offset are free.
    - `stride`: the distance between the rows and columns of the reference that are compared, in
      pixels.
    """

    views: Views
    clear: Bool[Array, "height width"]
    unit: Float[Array, "6"]
    scale: Float[Array, "2"]
    hole_threshold: int | float = eqx.field(static=True)
    exposure: bool = eqx.field(static=True)
    stride: int = eqx.field(static=True)

    def moved(self, twist: Float[Array, "6"]) -> PinholeCamera:
        """The start's camera after a twist."""
        start = self.views.start
        pose = start.world_from_camera.astype(float) @ rigid(twist * self.unit)
        return PinholeCamera(start.intrinsics, pose.astype(start.world_from_camera.dtype))

    def _thinned(self, image: Array) -> Array:
        """The middle pixel of each square of `stride` pixels."""
        first = self.stride // 2
        return image[first :: self.stride, first :: self.stride]

    def compare(self, twist: Float[Array, "6"]) -> Comparison:
        """The differences between the source, as it looks after a twist, and the reference."""
        views, camera = self.views, self.moved(twist)
        rows, columns, _ = views.reference.shape
        pixels = self._thinned(pixel_centers(rows, columns, views.depth.dtype))
        size, flat = pixels.shape[:2], pixels.reshape(-1, 2)
        options = {"search": "pyramid", "hole_threshold": self.hole_threshold}
        view = trace_pixels(views.depth, views.source, camera, flat, **options)
        is_clear = view.mask & nearest(self.clear, view.pixels)
        ignored = (~is_clear.reshape(size) | is_frame(size)).astype(float)
        counts = 1 - largest(jax.lax.stop_gradient(ignored))
        shown = bilinear(views.image, view.pixels).reshape(*size, -1)
        reference = self._thinned(views.reference)
        scale = self.scale.astype(shown.dtype)
        gain, offset = exposure_between(shown, reference, counts, scale[0], self.exposure)
        differences = [(gain * shown + offset - reference) / scale[0]]
        if views.reference_depth is not None:
            own_depth = self._thinned(views.reference_depth)
            depth = safe_divide(jnp.ones_like(view.reciprocal_depth), view.reciprocal_depth)
            point = views.source.unproject(view.pixels, depth)
            point = jnp.where(view.mask[:, None], point, 0)
            seen_depth = camera.project(point)[1].reshape(size)
            is_known = (own_depth > 0) & jnp.isfinite(own_depth) & view.mask.reshape(size)
            relative = seen_depth / jnp.where(is_known, own_depth, 1) - 1
            relative = jnp.where(is_known, relative, 0)
            differences.append(relative[..., None] / scale[1])
        deviations = jnp.concatenate([each.astype(float) for each in differences], axis=-1)
        contrast = _contrast(reference, counts)
        return Comparison(deviations, counts, gain[0, 0], offset[0, 0], contrast)

    def __call__(
        self, twist: Float[Array, "6"]
    ) -> tuple[Float[Array, "rows columns value"], Comparison]:
        """The weighted residual, and the comparison that it is made of."""
        compared = self.compare(twist)
        return self.weighted(compared), compared

    def weighted(self, compared: Comparison) -> Float[Array, "rows columns value"]:
        """Residuals whose squares are Huber's loss, in units of radiance; 0 where not compared.

        They are divided by the root of the ratio of pixels that are compared: to turn away from
        what differs shall not lower the loss.
        """
        counts = compared.counts
        ratio = jnp.maximum(jnp.mean(counts), 1 / counts.size)
        return (
            self.scale[0] * huber(compared.deviations) * (counts / jnp.sqrt(ratio))[..., None]
        )


def _contrast(reference: Array, counts: Array) -> Array:
    """Mean square of an image about its mean, over the pixels that count."""
    weight = counts[..., None] / jnp.maximum(jnp.sum(counts), 1)
    weight = weight.astype(reference.dtype)
    mean = jnp.sum(weight * reference, axis=(0, 1), keepdims=True)
    return jnp.mean(jnp.sum(weight * (reference - mean) ** 2, axis=(0, 1)))


def largest(x: Array, size: int = 3) -> Array:
    """The maximum over `size` x `size` pixels about each."""
    window = (size, size)
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 1), "SAME")


@eqx.filter_jit
def clear_of_steps(depth: Array, threshold: int | float) -> Bool[Array, "height width"]:
    """Where no step in depth, by a ratio above `1 + threshold`, is within two texels.

    A hole is no step: across a hole of one or two texels the depths about it are compared.
    """
    known = depth > 0
    inverse_depth = safe_divide(known.astype(depth.dtype), jnp.where(known, depth, 1))
    beside_hole = largest((~known).astype(depth.dtype)) > 0

    def is_step(size: int) -> Array:
        nearest_one = largest(jnp.where(known, inverse_depth, -jnp.inf), size)
        farthest = -largest(jnp.where(known, -inverse_depth, -jnp.inf), size)
        return (nearest_one > (1 + threshold) * farthest) & (nearest_one > 0)

    step = is_step(3) | (beside_hole & is_step(5))
    return (largest(step.astype(depth.dtype)) == 0) & ~is_frame(depth.shape)


def is_frame(size: tuple[int, ...]) -> Bool[Array, "height width"]:
    """The pixels within `_FRAME` of the border of an image of this height and width."""
    inner = (slice(_FRAME, size[0] - _FRAME), slice(_FRAME, size[1] - _FRAME))
    return jnp.ones(size, bool).at[inner].set(False)


def rigid(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a twist: three of translation, three of rotation in radians."""
    generator = jnp.zeros((4, 4), twist.dtype).at[:3, 3].set(twist[:3])
    x, y, z = twist[3:]
    zero = jnp.zeros_like(x)
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    motion = jax.scipy.linalg.expm(generator.at[:3, :3].set(turn))
    # The last row exactly: the exponential rounds it.
    return motion.at[3].set(jnp.eye(4, dtype=motion.dtype)[3])
