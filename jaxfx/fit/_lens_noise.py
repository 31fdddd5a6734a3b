"""The noise that `fit.dof` estimates for each pixel.

A photograph with a wide aperture shows surfaces that are hidden in the image from which the
effect is drawn. Near an edge in depth, the drawn image is therefore wrong by more than noise.
So pixels near edges get a standard deviation of their own, larger than that of the others.
Pixels that differ by many standard deviations (a lamp) are left out.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx.dof.spoiled import spoiled
from jaxfx.fit._in_program import each
from jaxfx.fit._lens_model import DISPARITY, IRIS, LENS, Model, Values
from jaxfx.fit._lens_residual import Residual, evaluate


# Second difference of the defocus between neighbouring pixels, in pixels, from which on there
# is an edge in depth; it is 0 on a plane. A larger one misses edges between surfaces that lie
# close, a smaller one takes curved surfaces for edges.
_STEP = 0.25

# The part of Gaussian differences that is smaller than one standard deviation, a ratio.
_WITHIN = 0.68

# The least standard deviation, as a ratio to that of the references: about a quarter of a step
# of 8 bits. With less, rounding of an exact fit would be taken for noise.
_LEAST_NOISE = 1e-3

# A pixel that differs by more standard deviations than this is left out until the noise is
# estimated again: the loss of a lamp would be so large that improvements elsewhere vanish in
# it. Below about 5, pixels are left out that show the effect of the lens.
_OUTLIER = 20.0

# By how much an unknown (a logarithm) is moved to see which pixels depend on it. A smaller one
# measures rounding in float32, a larger one is no longer linear.
_NUDGE = 0.03


def weighed(residual: Residual, unknowns: Values, has_edges: bool) -> Residual:
    """The residual with the noise that its pixels have at these unknowns, and Huber's loss.

    The noise is a quantile of the differences of pixels, each weighted by how much the pixel
    depends on the parameters that are fitted. Unweighted, it would be that of even surfaces, in
    which the lens does not show.
    `has_edges`: whether pixels that the sprite of an edge in depth reaches have a noise of
    their own.
    """
    compared = evaluate(residual, unknowns)
    names = [name for name in unknowns if name in LENS + DISPARITY + IRIS]
    names = names or [name for name in unknowns if name != "footprint"]
    nudged = [unknowns | {name: unknowns[name] + _NUDGE} for name in names]
    images = lambda at: evaluate(residual, at).corrected
    change = lambda nudged: (images(nudged) - compared.corrected) ** 2
    sensitivity = functools.reduce(jnp.add, each(change, nudged, (residual, unknowns)))
    values = residual.model.values(unknowns)
    scale, unit = _noise(residual.model, values, compared.difference, sensitivity, has_edges)
    return dataclasses.replace(residual, scale=scale, unit=unit, is_robust=True)


@eqx.filter_jit
def _noise(model, values, difference, sensitivity, has_edges):
    """Standard deviations in units of radiance: per pixel, and of pixels far from edges.

    The first is inf for pixels that are left out.
    """
    sensitivity = sensitivity * model.images.weights[None, ..., None]
    tiny = jnp.finfo(sensitivity.dtype).tiny
    least = _LEAST_NOISE * jnp.std(model.images.references) + tiny
    deviation = functools.partial(_deviation, jnp.abs(difference), least=least)
    size = jnp.max(jnp.abs(difference), axis=-1)
    without_outliers = lambda scale: jnp.where(size > _OUTLIER * scale, jnp.inf, scale)
    if not has_edges:
        everywhere = deviation(sensitivity)
        return without_outliers(jnp.full(size.shape, everywhere)), everywhere
    reached = functools.partial(_near_edges, max_coc=model.max_coc)
    is_near = jax.vmap(reached)(defocus(model, values), model.circles(values))
    near = is_near[..., None]
    away = deviation(jnp.where(near, 0, sensitivity))
    beside = deviation(jnp.where(near, sensitivity, 0))
    # Where no pixel far from edges depends on the lens, those beside them are all there is.
    away = jnp.where(jnp.any(~near & (sensitivity > 0)), away, beside)
    scale = jnp.where(is_near, jnp.maximum(beside, away), away)
    return without_outliers(scale), away


def defocus(model: Model, values: Values) -> Float[Array, "photograph height width"]:
    """The defocus in pixels, NaN where the depth is missing."""
    depth, _ = model.depths(values)
    count = model.images.focal_pixels.size
    signed = [model.lens(values, photograph).defocus(depth) for photograph in range(count)]
    return jnp.where(depth > 0, jnp.stack(signed), jnp.nan)


def _near_edges(defocus: Array, circles: Array, max_coc: int | float) -> Array:
    """The pixels that the sprites of an edge in depth reach, or those of the frame's border.

    The border counts as an edge, because no image holds what lies beyond it. A missing depth is
    no edge: its difference to its neighbours is NaN.
    """
    edge = jnp.ones(defocus.shape, bool).at[1:-1, 1:-1].set(False)
    # The defocus of a plane is linear in the pixel's place, so that a slope is no edge.
    for axis in (0, 1):
        bend = jnp.abs(jnp.diff(defocus, n=2, axis=axis)) > _STEP
        edge = edge | jnp.pad(bend, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
    return spoiled(edge, circles + 2, max_coc + 2)


def _deviation(size: Array, weight: Array, least: Array) -> Array:
    """A standard deviation: the size below which `_WITHIN` of the weight lies."""
    order = jnp.argsort(size.reshape(-1))
    total = jnp.cumsum(weight.reshape(-1)[order])
    at = jnp.searchsorted(total, _WITHIN * total[-1])
    return jnp.maximum(size.reshape(-1)[order][jnp.minimum(at, size.size - 1)], least)
