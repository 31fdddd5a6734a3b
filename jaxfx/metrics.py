"""Scores of an image against its reference, differentiable.

| I want | call |
|---|---|
| decibels of the mean squared error | `metrics.psnr` |
| the same near silhouettes only | `metrics.psnr(..., mask=...)` |
| structural similarity, as scikit-image has it | `metrics.ssim` |
| the same, as its paper has it | `metrics.ssim(..., window="gaussian")` |
"""

from functools import partial, reduce
from operator import add
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_array, check, check_image, is_concrete, option, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import one_program, working_dtype


__all__ = ["psnr", "ssim"]


def _pair(
    function: str, image: Any, reference: Any, data_range: Any
) -> tuple[Float[Array, "h w c"], Float[Array, "h w c"], Float[Array, ""]]:
    """The two images and the range of their values, checked and in one working type."""
    image = check_image(f"{function}(image)", image)
    reference = check_image(f"{function}(reference)", reference)
    if reference.shape != image.shape:
        raise ValueError(
            f"`{function}(reference)` must have the image's shape {image.shape}, "
            f"got {reference.shape}."
        )
    name = f"{function}(data_range=...)"
    data_range = parameter(name, data_range)
    check(name, data_range, lambda v: (v > 0) & (v < np.inf), "positive")
    dtype = working_dtype(image.dtype, reference.dtype)
    return image.astype(dtype), reference.astype(dtype), data_range.astype(dtype)


@on_any_mesh
def psnr(
    image: Float[ArrayLike, "height width channel"],
    reference: Float[ArrayLike, "height width channel"],
    *,
    data_range: Any = 1.0,
    mask: Bool[ArrayLike, "height width"] | None = None,
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio: `10 log10(data_range^2 / mean squared error)`.

    **Arguments:**

    - `image`, `reference`: height width channel.
    - `data_range`: the largest value less the smallest that the images can hold, in their
      unit.
    - `mask`: height width; pixels where it is false are left out, whatever they hold. A band
      of one circle of confusion around the silhouettes, say.

    **Returns:** decibels, in float32 or wider. Equal images give inf; a mask with no pixel,
    where it is traced, NaN.

    **Raises:** `ValueError` for images of different shapes, a `data_range` that is not
    positive, a mask that does not fit or has no pixel.

    **Gradient:** exact; zero where the images are equal, since the value is inf there. `mask`
    has none.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import metrics
    >>> float(metrics.psnr(np.full((8, 8, 3), 0.5), np.full((8, 8, 3), 0.6)).round(1))
    20.0
    """
    image, reference, data_range = _pair("psnr", image, reference, data_range)
    if mask is not None:
        mask = as_array("psnr(mask=...)", mask)
        if mask.shape != image.shape[:2] or mask.dtype != jnp.bool_:
            raise ValueError(
                f"`psnr(mask=...)` must hold booleans of shape {image.shape[:2]}, "
                f"got {mask.dtype} of shape {mask.shape}."
            )
        if is_concrete(mask) and not np.any(np.asarray(mask)):
            raise ValueError("`psnr(mask=...)` must have a true pixel, got none.")
    return _psnr(image, reference, data_range, mask)


@one_program
def _psnr(image, reference, data_range, mask):
    error = image - reference
    count = np.prod(error.shape)
    if mask is not None:
        error = jnp.where(mask[:, :, None], error, 0)
        count = jnp.sum(mask) * error.shape[2]
    mean = jnp.sum(error * error) / jnp.asarray(count, error.dtype)
    equal = mean == 0
    ratio = data_range * data_range / jnp.where(equal, 1, mean)
    return jnp.where(equal, jnp.inf, 10 * jnp.log10(ratio))


def _gaussian(radius: int, sigma: float) -> tuple[float, ...]:
    """Weights of sum 1 at offsets from `-radius` to `radius` pixels."""
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return tuple((weights / weights.sum()).tolist())


# The weights of a window along one axis, and the factor on its variances: that of 49 samples
# makes them unbiased; the paper has none.
_WINDOWS = {
    "uniform": ((1 / 7,) * 7, 49 / 48),
    "gaussian": (_gaussian(5, 1.5), 1.0),
}


@on_any_mesh
def ssim(
    image: Float[ArrayLike, "height width channel"],
    reference: Float[ArrayLike, "height width channel"],
    *,
    data_range: Any = 1.0,
    window: Literal["uniform", "gaussian"] = "uniform",
) -> Float[Array, ""]:
    """Structural similarity, the mean over channels and over all windows inside the image.

    **Arguments:**

    - `image`, `reference`: height width channel, as tall and as wide as the window at least.
    - `data_range`: the largest value less the smallest that the images can hold, in their
      unit.
    - `window`: "uniform", 7x7 with the sample covariance, what scikit-image does unless told
      otherwise; or "gaussian", 11x11 with a standard deviation of 1.5 pixels, the paper's.

    **Returns:** a number in [-1, 1], in float32 or wider; 1 for equal images.

    **Raises:** `ValueError` for images of different shapes or smaller than the window, a
    `data_range` that is not positive, or an unknown `window`.

    **Gradient:** exact; zero where the images are equal.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import metrics
    >>> image = np.random.default_rng(0).random((8, 8, 3))
    >>> float(metrics.ssim(image, image).round(3))
    1.0

    Source: Wang, Bovik, Sheikh & Simoncelli 2004, eq. 13, with K1 = 0.01 and K2 = 0.03.
    """
    option("ssim(window=...)", window, tuple(_WINDOWS))
    image, reference, data_range = _pair("ssim", image, reference, data_range)
    size = len(_WINDOWS[window][0])
    if min(image.shape[:2]) < size:
        raise ValueError(
            f"`ssim(image)` must have at least {size} x {size} pixels for the {window} window, "
            f"got {image.shape[0]} x {image.shape[1]}."
        )
    return _ssim_of_images(image, reference, data_range, window)


@partial(jax.jit, static_argnums=3)
def _ssim_of_images(
    image: Float[Array, "h w c"],
    reference: Float[Array, "h w c"],
    data_range: Float[Array, ""],
    window: str,
) -> Float[Array, ""]:
    """`ssim` of checked arguments."""
    # Channels side by side in a row: long rows are quicker than a short last axis.
    x, y = (a.reshape(a.shape[0], -1) for a in (image, reference))
    return _ssim(jnp.stack([x + y, x - y]), data_range, window, image.shape[2])


def _taps(values: Array, count: int, axis: int, step: int) -> list[Array]:
    """Slices of one size of `values`, `step` apart along `axis`."""
    length = values.shape[axis] - (count - 1) * step
    starts = [i * step for i in range(count)]
    return [lax.slice_in_dim(values, start, start + length, axis=axis) for start in starts]


def _mean(values: list[Array], weights: tuple[float, ...]) -> Array:
    """The weighted sum; `weights` have the sum 1."""
    return reduce(add, [w * value for w, value in zip(weights, values, strict=True)])


def _moments(
    fields: Float[Array, "2 h wc"], weights: tuple[float, ...], channels: int
) -> tuple[Array, Array]:
    """Mean and variance over every window inside, by the law of total variance.

    Unlike a mean of squares less the square of the mean it subtracts no large numbers. `fields`
    are rows of pixels whose channels lie side by side.
    """

    def widen(moments: tuple[Array, Array], axis: int, step: int) -> tuple[Array, Array]:
        values, within = (_taps(moment, len(weights), axis, step) for moment in moments)
        mean = _mean(values, weights)
        spread = [
            inner + (value - mean) ** 2 for inner, value in zip(within, values, strict=True)
        ]
        return mean, _mean(spread, weights)

    # A loop over the fields, for XLA would fuse one pass into every tap of the next.
    moments = lax.map(partial(widen, axis=0, step=1), (fields, jnp.zeros_like(fields)))
    return lax.map(partial(widen, axis=1, step=channels), moments)


def _spread(
    fields: Float[Array, "2 h wc"], weights: tuple[float, ...], channels: int
) -> Float[Array, "2 H WC"]:
    """The transpose of the weighted mean over windows: from windows back to pixels."""

    def narrow(values: Array, axis: int, step: int) -> Array:
        far = (len(weights) - 1) * step
        margin = [(far, far) if i == axis else (0, 0) for i in range(2)]
        return _mean(_taps(jnp.pad(values, margin), len(weights), axis, step), weights[::-1])

    rows = lax.map(partial(narrow, axis=0, step=1), fields)
    return lax.map(partial(narrow, axis=1, step=channels), rows)


def _similarity(means: Array, variances: Array, data_range: Array, unbias: float) -> Array:
    """The paper's eq. 13 in the moments of x + y and x - y, which need no covariance."""
    (square_t, square_d), (var_t, var_d) = means * means, variances * unbias
    c1, c2 = 2 * (0.01 * data_range) ** 2, 2 * (0.03 * data_range) ** 2
    luminance = (square_t - square_d + c1) / (square_t + square_d + c1)
    structure = (var_t - var_d + c2) / (var_t + var_d + c2)
    return jnp.mean(luminance * structure)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _ssim(
    fields: Float[Array, "2 h wc"], data_range: Float[Array, ""], window: str, channels: int
) -> Float[Array, ""]:
    """SSIM from the fields x + y and x - y, with a derivative of its own."""
    weights, unbias = _WINDOWS[window]
    return _similarity(*_moments(fields, weights, channels), data_range, unbias)


@_ssim.defjvp
def _ssim_jvp(
    window: str, channels: int, primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The gradient in closed form: a few blurs, where the transpose of slices is many pads."""
    fields, data_range = primals
    weights, unbias = _WINDOWS[window]
    means, variances = _moments(fields, weights, channels)
    similarity = partial(_similarity, unbias=unbias)
    value, pull = jax.vjp(similarity, means, variances, data_range)
    by_mean, by_variance, by_range = pull(jnp.ones_like(value))
    # The derivative of a variance by a value is 2 w (value - mean), w its weight in the window.
    constant = _spread(by_mean - 2 * by_variance * means, weights, channels)
    slope = constant + 2 * fields * _spread(by_variance, weights, channels)
    return value, jnp.sum(slope * tangents[0]) + by_range * tangents[1]
