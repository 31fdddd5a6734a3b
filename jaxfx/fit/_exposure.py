"""The gain and offset of each channel between two images, as a fit's residual takes them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfx.fit._robust import CORNER


# A contrast of an image below this ratio to the reference's does not determine a gain, which
# then stays near 1. With a larger one every gain is drawn towards 1.
_RIDGE = 1e-4

# The least gain, a ratio. At 0 a fit of a pose could turn away from the scene and explain the
# photograph by its mean color.
_LEAST_GAIN = 0.1

# Solutions: by least squares, then once with Huber's weights of what is left.
_SOLUTIONS = 2


def exposure_between(
    shown: Array, reference: Array, counts: Array, scale: Array, is_free: bool
) -> tuple[Array, Array]:
    """Gain and offset, 1 1 channel each, that bring `shown` to `reference`.

    `shown` and `reference` are height width channel, `counts` height width, the weight of each
    pixel; `scale` is the standard deviation of noise, which sets Huber's corner. With `is_free`
    false they are 1 and 0. The residual of a fit is taken after the best exposure (variable
    projection), and its derivative contains that of the exposure.
    """
    gain, offset = jnp.ones_like(shown[:1, :1]), jnp.zeros_like(shown[:1, :1])
    hold, counted = jax.lax.stop_gradient, counts.astype(shown.dtype)[..., None]
    for _ in range(_SOLUTIONS if is_free else 0):
        rest = jnp.abs(gain * shown + offset - reference) / scale
        weight = counted * jnp.minimum(1, CORNER / jnp.maximum(hold(rest), CORNER))
        weight = weight / jnp.maximum(jnp.sum(weight, axis=(0, 1), keepdims=True), 1e-6)
        mean = lambda x, weight=weight: jnp.sum(weight * x, axis=(0, 1), keepdims=True)
        shown_mean, reference_mean = mean(shown), mean(reference)
        ridge = _RIDGE * mean((reference - reference_mean) ** 2) + jnp.finfo(shown.dtype).tiny
        shared = mean((shown - shown_mean) * (reference - reference_mean))
        gain = (shared + ridge) / (mean((shown - shown_mean) ** 2) + ridge)
        gain = jnp.maximum(gain, _LEAST_GAIN)
        offset = reference_mean - gain * shown_mean
    return gain, offset
