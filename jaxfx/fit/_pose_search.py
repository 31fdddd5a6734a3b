"""The search of `fit.camera`, from small blurred images to the given ones."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete
from jaxfx._loops import scan, varying_as
from jaxfx.fit._descent import End, linear
from jaxfx.fit._pose_residual import Comparison, Residual, Views, clear_of_steps
from jaxfx.fit._reduction import reduced, shrunk, thinned


# The sigma of the widest blur, as a ratio to the smaller side of the image; that of the last is
# a pixel. A wider one blurs a scene to its mean, a narrower one needs a nearer start.
_WIDEST = 1 / 16

# The largest side of the images of all but the last steps, in pixels: their time grows with its
# square.
_COARSE = 160

# Of such smaller images, one pixel in this many is compared along either axis.
_STRIDE = 2

# Pixels of the reference in the last steps, about; more make them slower and the pose surer.
_PIXELS = 160 * 120

# When the search at one blur ends, before that at the next; and the last one. See `descend`.
_SOON = {"patience": 2, "gain": 1e-2}
_LAST = {"gain": 1e-4}

# The standard deviation of Gaussian noise over the median of its absolute values.
_DEVIATION_OF_MEDIAN = 1.4826

# The least standard deviations of noise: of color, as a ratio to the root mean square contrast
# and in units of radiance; of relative depth, a ratio. Without them an exact reprojection would
# be divided by 0.
_LEAST_COLOR, _LEAST_RADIANCE, _LEAST_DEPTH = 1e-3, 1e-9, 1e-4
# What is `_SKY` times as far as the nearest `_NEAR` of the pixels, ratios, has no share in the
# unit of translations: renderers write 1e10 or more for a sky, which does not move.
_SKY, _NEAR = 1e3, 0.05


def search(
    views: Views, threshold: float, exposure: bool, descend_on: Callable[..., End]
) -> tuple[Residual, End]:
    """The pose, searched from one blur to the next on small images, then on the given ones.

    Returns the residual of the last search and where that ended, with the losses of all.
    """
    unit = jnp.concatenate([jnp.full(3, _unit(views.depth)), jnp.ones(3, float)])

    def model(views: Views, sigma: Any, twist: Array, stride: int = 1) -> Residual:
        """The residual of images blurred by `sigma`, with the scale of noise at the twist.

        `sigma` is in pixels of the coarser of both images; the finer one is blurred alike in
        the scene.
        """
        finer = views.source.intrinsics[0, 0] / views.start.intrinsics[0, 0]
        soft = views._replace(
            reference=blurred(views.reference, sigma * jnp.maximum(1 / finer, 1)),
            image=blurred(views.image, sigma * jnp.maximum(finer, 1)),
        )
        clear = clear_of_steps(views.depth, threshold)
        first = Residual(soft, clear, unit, jnp.ones(2, float), threshold, exposure, stride)
        # By the program of the search: its derivative is not needed here, but a program for the
        # comparison alone would take seconds to compile.
        comparison = linear(first, twist).aux.details
        return eqx.tree_at(lambda m: m.scale, first, _scale(comparison))

    small = _small(views)
    # The last steps on the given images make up for what these leave out.
    stride = 1 if small is views else _STRIDE
    twist, losses = varying_as(views, jnp.zeros(6, float)), []
    sharpest, *coarse = reversed(_sigmas(min(small.reference.shape[:2])))

    def sharpened(twist: Array, sigma: Any) -> tuple[Array, list[Array]]:
        end = descend_on(model(small, sigma, twist, stride), twist, **_SOON)
        return end.unknowns, end.losses

    if is_concrete(views):
        for sigma in reversed(coarse):
            twist, more = sharpened(twist, sigma)
            losses += more
    elif coarse:  # One program for all blurs.
        sigmas = jnp.asarray(coarse[::-1], views.source.intrinsics.dtype)
        twist, (steps, ends) = scan(sharpened, twist, sigmas)
        losses.append(jnp.concatenate([steps, ends[:, None]], axis=1))
    last = model(small, sharpest, twist, stride)
    if small is not views:
        end = descend_on(last, twist, **_SOON)
        twist, losses = end.unknowns, losses + end.losses
        pixels = math.prod(views.reference.shape[:2])
        last = model(views, sharpest, twist, math.ceil(math.sqrt(pixels / _PIXELS)))
    end = descend_on(last, twist, **_LAST)
    return last, end._replace(losses=losses + end.losses)


@jax.jit
def _unit(depth: Array) -> Float[Array, ""]:
    """The unit of translations in scene units: the median depth of what is near.

    Of the nearest known depth in each square of a reduced image: to sort all takes as long as
    some steps of the search.
    """
    factor = math.ceil(max(depth.shape) / _COARSE)
    is_known = jnp.isfinite(depth) & (depth > 0)
    square = (factor, factor)
    nearest = jax.lax.reduce_window(
        jnp.where(is_known, depth, jnp.inf), jnp.inf, jax.lax.min, square, square, "SAME"
    )
    known = jnp.where(jnp.isfinite(nearest), nearest, jnp.nan)
    is_near = known <= _SKY * jnp.nanquantile(known, _NEAR)
    return jnp.nanmedian(jnp.where(is_near, known, jnp.nan)).astype(float)


def _sigmas(side: int) -> list[float]:
    """The sigmas of the blurs in pixels, from coarse to fine, for images of this side."""
    halvings = int(math.log2(max(1, _WIDEST * side)))
    return [2.0**level for level in range(halvings, -1, -1)]


def _small(views: Views) -> Views:
    """The views with images of at most `_COARSE` pixels a side, and the cameras of those."""
    reference_factor, source_factor = (
        math.ceil(max(size) / _COARSE)
        for size in (views.reference.shape[:2], views.depth.shape)
    )
    if reference_factor == source_factor == 1:
        return views
    own_depth = views.reference_depth
    return Views(
        reduced(views.reference, reference_factor),
        None if own_depth is None else thinned(own_depth, reference_factor),
        reduced(views.image, source_factor),
        thinned(views.depth, source_factor),
        shrunk(views.source, source_factor),
        shrunk(views.start, reference_factor),
    )


def _scale(comparison: Comparison) -> Float[Array, "2"]:
    """Standard deviations of noise in color and, where the reference has one, in depth.

    From the median of the absolute differences, which outliers do not move.
    """
    channels = comparison.gain.size
    is_compared = comparison.counts[..., None] > 0
    sizes = jnp.where(is_compared, jnp.abs(comparison.deviations), jnp.nan)
    color, depth = sizes[..., :channels], sizes[..., channels:]
    least = _LEAST_COLOR * jnp.sqrt(comparison.contrast.astype(float)) + _LEAST_RADIANCE
    color = jnp.nan_to_num(_DEVIATION_OF_MEDIAN * jnp.nanmedian(color))
    color = jnp.maximum(color, least)
    if depth.size == 0:
        return jnp.stack([color, jnp.ones_like(color)])
    depth = _DEVIATION_OF_MEDIAN * jnp.nanmedian(jnp.where(depth > 0, depth, jnp.nan))
    return jnp.stack([color, jnp.maximum(jnp.nan_to_num(depth, nan=1.0), _LEAST_DEPTH)])


@jax.jit
def blurred(image: Array, sigma: Array) -> Float[Array, "height width channel"]:
    """An image blurred by a Gaussian, normalised inside the frame.

    As a product of matrices: `sigma`, in pixels, is traced, so that all blurs share a program.
    """

    def weights(size: int) -> Float[Array, "size size"]:
        place = jnp.arange(size, dtype=image.dtype) / sigma.astype(image.dtype)
        weight = jnp.exp(-0.5 * (place[:, None] - place[None]) ** 2)
        return weight / jnp.sum(weight, axis=1, keepdims=True)

    down, across = map(weights, image.shape[:2])
    return jnp.einsum("ij,jkc,lk->ilc", down, image, across)
