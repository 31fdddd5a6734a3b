"""The residual of a pose: what reprojection shows from there, less a photograph."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import safe_divide
from jaxfx._sampling import bilinear, nearest, pixel_centers
from jaxfx.camera import PinholeCamera
from jaxfx.fit._descent import CORNER, huber
from jaxfx.reproject._view import look


# A contrast below this share of the photograph's does not tell a gain, which stays 1; a gain
# is never less than the second number: at 0 the source would be looked away from.
_RIDGE, _LEAST_GAIN = 1e-4, 0.1

# Pixels at the edge of an image, whose blur lacks what is outside.
_FRAME = 2


class Views(NamedTuple):
    """A photograph with its own depth, if any, and a source with its depth; their cameras.

    All have the size at which they are compared.
    """

    reference: Float[Array, "rows columns channel"]
    reference_depth: Float[Array, "rows columns"] | None
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    source: PinholeCamera
    start: PinholeCamera


class Residual(eqx.Module):
    """The reprojected image less the reference, where both are known, from a pose.

    - `views`: the images, blurred alike, their depths and cameras.
    - `clear`: the texels of the source that may be seen: no step in depth is near.
    - `unit`: the unit of each part of a twist: scene units, then radians.
    - `scale`: the standard deviation of noise, in units of radiance and of relative depth.
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

    def eye(self, twist: Float[Array, "6"]) -> PinholeCamera:
        """The start moved by a twist, in its own axes."""
        start = self.views.start
        moved = start.world_from_camera.astype(float) @ rigid(twist * self.unit)
        return PinholeCamera(start.intrinsics, moved.astype(start.world_from_camera.dtype))

    def _thinned(self, image: Array) -> Array:
        """The middle pixel of each square of `stride` pixels."""
        first = self.stride // 2
        return image[first :: self.stride, first :: self.stride]

    def compare(self, twist: Float[Array, "6"]) -> "Comparison":
        """The difference per pixel between the reprojected source and the reference."""
        views, eye = self.views, self.eye(twist)
        rows, columns, _ = views.reference.shape
        pixels = self._thinned(pixel_centers(rows, columns, views.depth.dtype))
        size, flat = pixels.shape[:2], pixels.reshape(-1, 2)
        options = {"method": "pyramid", "hole_threshold": self.hole_threshold}
        view = look(views.depth, views.source, eye, flat, **options)
        sees = view.mask & nearest(self.clear, view.pixels)
        ignored = (~sees.reshape(size) | is_frame(size)).astype(float)
        counts = 1 - largest(jax.lax.stop_gradient(ignored))
        shown = bilinear(views.image, view.pixels).reshape(*size, -1)
        reference = self._thinned(views.reference)
        scale = self.scale.astype(shown.dtype)
        gain, offset = exposure_between(shown, reference, counts, scale[0], self.exposure)
        differences = [(gain * shown + offset - reference) / scale[0]]
        if views.reference_depth is not None:
            own = self._thinned(views.reference_depth)
            depth = safe_divide(jnp.ones_like(view.inverse_depth), view.inverse_depth)
            point = views.source.unproject(view.pixels, depth)
            seen = eye.project(jnp.where(view.mask[:, None], point, 0))[1].reshape(size)
            known = (own > 0) & jnp.isfinite(own) & view.mask.reshape(size)
            relative = jnp.where(known, seen / jnp.where(known, own, 1) - 1, 0)
            differences.append(relative[..., None] / scale[1])
        noise = jnp.concatenate([each.astype(float) for each in differences], axis=-1)
        contrast = _contrast(reference, counts)
        return Comparison(noise, counts, gain[0, 0], offset[0, 0], contrast)

    def __call__(self, twist: Float[Array, "6"]) -> Float[Array, "rows columns channel"]:
        return self.weighted(self.compare(twist))

    def weighted(self, found: "Comparison") -> Float[Array, "rows columns channel"]:
        """The residuals of Huber's loss, in units of radiance, of the pixels that count."""
        # By the root of their share: to look away from what differs shall not pay.
        share = jnp.maximum(jnp.mean(found.counts), 1 / found.counts.size)
        return self.scale[0] * huber(found.noise) * (found.counts / jnp.sqrt(share))[..., None]


class Comparison(NamedTuple):
    """The reprojected source less the reference, per pixel, after gain and offset.

    - `noise`: the difference, in standard deviations of the noise.
    - `counts`: 1 where a pixel is compared, 0 elsewhere.
    - `gain`, `offset`: a ratio and units of radiance.
    - `contrast`: the mean square of the reference about its mean, in squared units of radiance.
    """

    noise: Float[Array, "rows columns channel"]
    counts: Float[Array, "rows columns"]
    gain: Float[Array, " channel"]
    offset: Float[Array, " channel"]
    contrast: Float[Array, ""]


def exposure_between(
    shown: Array, reference: Array, counts: Array, scale: Array, is_free: bool
) -> tuple[Array, Array]:
    """For each channel the gain and the offset that bring what is shown to the reference.

    By least squares, then again with Huber's weights. A pose is sought with the best exposure
    for it (variable projection): its derivative contains that of the exposure.
    """
    gain, offset = jnp.ones_like(shown[:1, :1]), jnp.zeros_like(shown[:1, :1])
    hold, counted = jax.lax.stop_gradient, counts.astype(shown.dtype)[..., None]
    for _ in range(2 if is_free else 0):
        rest = jnp.abs(gain * shown + offset - reference) / scale
        weight = counted * jnp.minimum(1, CORNER / jnp.maximum(hold(rest), CORNER))
        weight = weight / jnp.maximum(jnp.sum(weight, axis=(0, 1), keepdims=True), 1e-6)
        mean = lambda x, weight=weight: jnp.sum(weight * x, axis=(0, 1), keepdims=True)
        middle, aim = mean(shown), mean(reference)
        ridge = _RIDGE * mean((reference - aim) ** 2) + jnp.finfo(shown.dtype).tiny
        shared = mean((shown - middle) * (reference - aim))
        gain = (shared + ridge) / (mean((shown - middle) ** 2) + ridge)
        gain = jnp.maximum(gain, _LEAST_GAIN)
        offset = aim - gain * middle
    return gain, offset


def _contrast(reference: Array, counts: Array) -> Array:
    """The mean square of what counts of an image about its mean."""
    weight = counts[..., None] / jnp.maximum(jnp.sum(counts), 1)
    weight = weight.astype(reference.dtype)
    middle = jnp.sum(weight * reference, axis=(0, 1), keepdims=True)
    return jnp.mean(jnp.sum(weight * (reference - middle) ** 2, axis=(0, 1)))


@eqx.filter_jit
def report(model: Residual, twist: Array) -> tuple[Array, Array, Comparison]:
    """The columns of the Jacobian, the residual, and what it is made of."""

    def both(twist: Array) -> tuple[Array, tuple[Array, Comparison]]:
        found = model.compare(twist)
        residual = model.weighted(found)
        return residual, (residual, found)

    columns, (residual, found) = jax.jacfwd(both, has_aux=True)(twist)
    return columns.reshape(-1, 6), residual, found


@jax.jit
def blurred(image: Array, sigma: Array) -> Float[Array, "height width channel"]:
    """A Gaussian of what is inside the frame: one program for all sigmas."""

    def weights(size: int) -> Float[Array, "size size"]:
        place = jnp.arange(size, dtype=image.dtype) / sigma.astype(image.dtype)
        weight = jnp.exp(-0.5 * (place[:, None] - place[None]) ** 2)
        return weight / jnp.sum(weight, axis=1, keepdims=True)

    down, across = map(weights, image.shape[:2])
    return jnp.einsum("ij,jkc,lk->ilc", down, image, across)


def largest(x: Array, size: int = 3) -> Array:
    """The largest of `size` x `size`."""
    window = (size, size)
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 1), "SAME")


@eqx.filter_jit
def clear_of_steps(depth: Array, threshold: int | float) -> Bool[Array, "height width"]:
    """Where no step in depth is within two texels.

    A hole is no step. Across a hole of a texel or two the depths about it are compared.
    """
    known = depth > 0
    inverse = safe_divide(known.astype(depth.dtype), jnp.where(known, depth, 1))
    beside_hole = largest((~known).astype(depth.dtype)) > 0

    def is_step(size: int) -> Array:
        nearest_one = largest(jnp.where(known, inverse, -jnp.inf), size)
        farthest = -largest(jnp.where(known, -inverse, -jnp.inf), size)
        return (nearest_one > (1 + threshold) * farthest) & (nearest_one > 0)

    step = is_step(3) | (beside_hole & is_step(5))
    return (largest(step.astype(depth.dtype)) == 0) & ~is_frame(depth.shape)


def is_frame(size: tuple[int, ...]) -> Bool[Array, "height width"]:
    """The pixels at the edge of an image, whose blur lacks what is outside."""
    inner = (slice(_FRAME, size[0] - _FRAME), slice(_FRAME, size[1] - _FRAME))
    return jnp.ones(size, bool).at[inner].set(False)


def rigid(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a twist: three of translation, three of rotation, in radians."""
    generator = jnp.zeros((4, 4), twist.dtype).at[:3, 3].set(twist[:3])
    x, y, z = twist[3:]
    zero = jnp.zeros_like(x)
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    motion = jax.scipy.linalg.expm(generator.at[:3, :3].set(turn))
    return motion.at[3].set(jnp.eye(4, dtype=motion.dtype)[3])  # To the last digit.


@functools.partial(jax.jit, static_argnames="factor")
def reduced(image: Array, factor: int) -> Array:
    """The means of squares of pixels; what is left over at the right and below is dropped."""
    rows, columns = (size // factor for size in image.shape[:2])
    image = image[: rows * factor, : columns * factor]
    return image.reshape(rows, factor, columns, factor, -1).mean(axis=(1, 3))


def thinned(depth: Array, factor: int) -> Array:
    """The depth in the middle of each square of pixels: no mean of two surfaces."""
    rows, columns = (size // factor for size in depth.shape)
    middle = depth[factor // 2 :: factor, factor // 2 :: factor]
    return middle[:rows, :columns]


def shrunk(eye: PinholeCamera, factor: int) -> PinholeCamera:
    """The camera of a reduced image."""
    scale = jnp.asarray([[1 / factor], [1 / factor], [1]], eye.intrinsics.dtype)
    return PinholeCamera(eye.intrinsics * scale, eye.world_from_camera)
