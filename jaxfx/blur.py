"""Gaussian and binomial blur, separable.

| I want | call |
|---|---|
| a blur of a given width | `gaussian(image, sigma=...)` |
| the same under `jit`, `grad` or `vmap` | `gaussian(image, sigma=..., taps=...)` |
| a small blur with exact binomial weights | `gaussian(image, taps=9)` |
| an image at half the size, without aliasing | `downsample(image)` |
| weights for a shader | `binomial_weights(taps, row=...)`, then `linear_taps(...)` |

Kept for comparison: `gaussian(sampling="linear")`, which is quicker on texture units alone, and
`gaussian(passes=...)`, several small blurs in place of a large one.
"""

import functools as ft
import math
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import (
    WholeNumber,
    as_array,
    check,
    check_image,
    is_concrete,
    option,
    parameter,
    whole_number,
)
from jaxfx._filter import (
    Sampling,
    discrete_terms,
    filter_tangent,
    linear_reads,
    separable,
)
from jaxfx._loops import fori_loop
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import working_dtype
from jaxfx._xla import added, apart


__all__ = ["LinearTaps", "binomial_weights", "downsample", "gaussian", "linear_taps"]

# Pixels squared. A smaller variance counts as this, so that it can divide. The neighbours'
# weights are then e**-500, 0 in float32; with a larger value a sigma near 0 would still blur.
_LEAST_VARIANCE = 1e-3
# The number of binomial weights by default, and the standard deviations to each side that the
# default taps of a Gaussian cover: 6e-5 of it lies beyond 4. Fewer cut the blur visibly, more
# cost time.
_DEFAULT_TAPS, _COVERED_DEVIATIONS = 9, 4


class LinearTaps(NamedTuple):
    """Reads between pixels that replace the taps of a filter, in ascending order.

    - `offsets`: reads; pixels from the filter's middle.
    - `weights`: reads; ratios, whose sum is that of the filter's weights.
    """

    offsets: Float[Array, "reads"]
    weights: Float[Array, "reads"]


@on_any_mesh
def gaussian(
    image: Float[ArrayLike, "height width channel"],
    *,
    taps: WholeNumber | None = None,
    passes: WholeNumber = 1,
    sampling: Sampling = "discrete",
    sigma: Float[ArrayLike, ""] | float | None = None,
    row: WholeNumber | None = None,
) -> Float[Array, "height width channel"]:
    """Gaussian blur, along the columns and then along the rows.

    Give `sigma` for a blur of that width; without it the weights are binomial.

    **Arguments:**

    - `image`: height width channel, any unit; light adds up in linear radiance.
    - `taps`: static; the pixels that one pass reads along an axis, odd. By default 9 for
      binomial weights; with `sigma`, as many as reach 4 standard deviations of one pass to each
      side, beyond which 6e-5 of a Gaussian lie. A traced `sigma`, under `jit`, `grad` or
      `vmap`, can't set them: then they must be given.
    - `passes`: static; how many times the filter is applied along both axes.
    - `sampling`: "discrete", one read per tap; or "linear", one read between two neighbouring
      taps, as `linear_taps` places it: equal but for rounding. That is for texture units; XLA
      has none, and reads the same pixels for it.
    - `sigma`: pixels, the standard deviation of the whole blur, all passes together; 0 is the
      identity. Weights beyond given taps are dropped: from about
      `sigma = sqrt(passes) * taps / 5` on the blur is weaker than asked for, and it tends to
      that of equal weights, `sqrt(passes * (taps**2 - 1) / 12)` pixels. Below 0.6 pixels per
      pass it is weaker, too, because few neighbours have any weight.
    - `row`: static; without `sigma`, the row of Pascal's triangle, of even index. By default
      `taps + 3`, of which the outer two on either side are dropped: 66, 220, 495, 792, 924, ...
      for 9 taps.

    **Returns:** height width channel, in the type of `image`. A pixel that is not finite spoils
    what the taps of all passes can reach, `passes * (taps // 2)` pixels along either axis.

    **Raises:** `ValueError` for a wrong shape, an integer image, an even or non-positive
    `taps`, `passes` below 1, a negative `sigma`, a traced or infinite `sigma` without `taps`, a
    `row` too short, `sigma` and `row` together, or an unknown `sampling`.

    **Gradient:** exact with respect to `image` and `sigma`; at `sigma` 0 it is 0 in `sigma`,
    which is the limit.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import blur
    >>> image = jnp.zeros((8, 8, 1)).at[4, 4].set(16)
    >>> print(blur.gaussian(image, taps=3, row=2)[4, 2:7, 0])
    [0. 2. 4. 2. 0.]
    >>> blur.gaussian(image, sigma=1.5).shape
    (8, 8, 1)

    A pixel becomes the mean of its neighbours, weighted by w_i w_j at an offset of (i, j)
    pixels; beyond the border the nearest pixel is repeated. The weights are binomial ones, or
    those of `exp(-i**2 / (2 sigma**2))`, and sum to 1. Variances add: n passes of k taps reach
    as far as one of n (k - 1) + 1 taps, for n k reads along each axis.

    Source: the product of two one-dimensional Gaussians; weights from binomial coefficients and
    linear sampling after Rakos 2010, efficient Gaussian blur with linear sampling.
    """
    image = check_image("gaussian(image)", image)
    # The middle of an even kernel lies between pixels: see `downsample`.
    is_odd = lambda n: n >= 1 and n % 2 == 1
    if taps is not None:
        taps = whole_number("gaussian(taps=...)", taps, is_odd, "an odd positive integer")
    passes = whole_number("gaussian(passes=...)", passes)
    option("gaussian(sampling=...)", sampling, get_args(Sampling))
    if sigma is None:
        taps = _DEFAULT_TAPS if taps is None else taps
        weights = _binomial("gaussian", taps, taps + 3 if row is None else row)
        return _binomial_blur(image, jnp.asarray(weights), passes, sampling)
    if row is not None:
        raise ValueError(
            f"`gaussian(row=...)` must be left out where `sigma` is given, got {row}."
        )
    deviation = parameter("gaussian(sigma=...)", sigma)
    check("gaussian(sigma=...)", deviation, lambda v: v >= 0, "0 or positive")
    taps = _default_taps(sigma, passes) if taps is None else taps
    return _gaussian_blur(image, deviation, taps, passes, sampling)


def _default_taps(sigma: Any, passes: int) -> int:
    """Taps of one of `passes` that together have the standard deviation `sigma`, in pixels."""
    if not is_concrete(sigma):
        raise ValueError(
            "`gaussian(taps=...)` must be given under `jit`, `grad` and `vmap`, where a traced "
            "`sigma` can't set it: static, `8 * sigma / sqrt(passes) + 1` pixels for the "
            "largest `sigma`, and odd, got None."
        )
    reach = _COVERED_DEVIATIONS * float(np.asarray(sigma)) / math.sqrt(passes)
    if not math.isfinite(reach):
        raise ValueError(f"`gaussian(sigma=...)` must be finite without `taps`, got {sigma}.")
    return 2 * math.ceil(reach) + 1


def binomial_weights(taps: WholeNumber, *, row: WholeNumber) -> Float[Array, "taps"]:
    """The middle of a row of Pascal's triangle, divided by its own sum.

    The weights of `gaussian` without `sigma`, for use elsewhere.

    **Arguments:**

    - `taps`: the number of weights, an integer; `row + 1` is the whole row.
    - `row`: index of the row, from 0, an integer; the taps must lie in its middle, so that one
      of `row` and `taps` is even.

    **Returns:** `taps` weights, symmetric, of sum 1, in the default float type.

    **Raises:** `ValueError` for a `taps` that is not positive, a row that is too short or whose
    middle lies between taps.

    **Gradient:** none; the arguments are integers.

    **Example:**

    >>> from jaxfx import blur
    >>> print(16 * blur.binomial_weights(5, row=4))
    [1. 4. 6. 4. 1.]

    Divided by the whole row's sum, 2 to the power of `row`, instead, the dropped weights would
    darken the image with every pass: by 4070 / 4096 along each axis for 9 taps of row 12.

    Source: Rakos 2010, efficient Gaussian blur with linear sampling; binomial weights tend to a
    Gaussian.
    """
    return jnp.asarray(_binomial("binomial_weights", taps, row))


@on_any_mesh
def linear_taps(
    tap_weights: Float[ArrayLike, "taps"],
) -> LinearTaps:
    """Half as many reads, between the pixels by linear interpolation, for the same sum.

    For a shader: a texture unit interpolates for free.

    **Arguments:** `tap_weights`: a ratio for each tap, one pixel apart, none negative. The
    middle is at offset 0: on a pixel for an odd number of taps, between two pixels for an even
    one.

    **Returns:** `LinearTaps` of `offsets`, in pixels from the middle, ascending, and `weights`.
    A pair of weight 0, or below 3e-10 in float32 and 1e-77 in float64, is read at its first
    pixel.

    **Raises:** `ValueError` for weights that are not a vector of floats, or where one is
    negative.

    **Gradient:** exact; zero in the offset of a pair of weight 0 or next to it.

    **Example:**

    >>> from jaxfx import blur
    >>> offsets, weights = blur.linear_taps(blur.binomial_weights(4, row=3))
    >>> print(offsets, weights)
    [-0.75  0.75] [0.5 0.5]

    Two neighbours with weights a and b, at o and o + 1, become one read at `o + b / (a + b)`
    with weight a + b. Pairs are taken outwards from the middle, so that a symmetric kernel
    stays symmetric. Where the middle tap of an odd kernel would have no partner, it is halved
    between both sides. So n taps take (n + 1) // 2 reads.

    Source: Rakos 2010, efficient Gaussian blur with linear sampling; the halved middle is ours.
    """
    array = as_array("linear_taps(tap_weights)", tap_weights)
    if array.ndim != 1 or not array.size or not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(
            "`linear_taps(tap_weights)` must be a vector of floats, "
            f"got {array.dtype} of shape {array.shape}."
        )
    check("linear_taps(tap_weights)", array, lambda v: v >= 0, "0 or positive")
    reads = linear_reads(array)
    middle = (array.size - 1) / 2
    offsets = jnp.stack([first - middle + share for first, share, _ in reads])
    return LinearTaps(offsets, jnp.stack([weight for _, _, weight in reads]))


@on_any_mesh
def downsample(
    image: Float[ArrayLike, "height width channel"], *, taps: WholeNumber = 2
) -> Float[Array, "half_height half_width channel"]:
    """The image at half its height and width, filtered by an even binomial kernel.

    The next level of a pyramid.

    **Arguments:**

    - `image`: height width channel, any unit.
    - `taps`: static; how many pixels are read along an axis, even: 2 is the mean of 2 x 2
      pixels, 4 has the weights 1, 3, 3, 1, and so on down Pascal's triangle.

    **Returns:** height / 2, width / 2, rounded up, and channel, in the type of `image`. A pixel
    that is not finite spoils what its taps reach.

    **Raises:** `ValueError` for a wrong shape, an integer image, or a `taps` that is not even
    and positive.

    **Gradient:** exact.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import blur
    >>> image = jnp.arange(8.0)[None, :, None] * jnp.ones((8, 1, 1))
    >>> small = blur.downsample(image)
    >>> print(small.shape, small[0, :, 0])
    (4, 4, 1) [0.5 2.5 4.5 6.5]

    A pixel of the result lies between pixels 2 i and 2 i + 1 of the image, where the middle of
    an even kernel is; beyond the border the nearest pixel is repeated.

    Source: the even rows of the binomial kernel, which Rakos 2010 names for a half-size image;
    Burt 1981 has them as generating kernels of pyramids.
    """
    image = check_image("downsample(image)", image)
    is_even = lambda n: n >= 2 and n % 2 == 0
    taps = whole_number("downsample(taps=...)", taps, is_even, "even and positive")
    weights = jnp.asarray(_binomial("downsample", taps, taps - 1))
    return _downsample(image, weights)


def _binomial(function: str, taps: Any, row: Any) -> Float[np.ndarray, "taps"]:
    """The middle `taps` of a row of Pascal's triangle, of sum 1."""
    taps = whole_number(f"{function}(taps=...)", taps)
    row = whole_number(
        f"{function}(row=...)",
        row,
        lambda row: row + 1 >= taps and (row + 1 - taps) % 2 == 0,
        f"{taps - 1}, {taps + 1}, {taps + 3} ..., so that {taps} taps lie in its middle",
    )
    dropped = row + 1 - taps
    kept = [math.comb(row, i) for i in range(dropped // 2, dropped // 2 + taps)]
    return np.array([weight / sum(kept) for weight in kept])


def _gaussian_weights(taps: int, sigma: Float[Array, ""], passes: int) -> Float[Array, "taps"]:
    """The weights of one of `passes`, which together have the standard deviation `sigma`."""
    distance = jnp.arange(taps, dtype=sigma.dtype) - taps // 2
    variance = jnp.maximum(sigma * sigma / passes, _LEAST_VARIANCE)
    weights = jnp.exp(-distance * distance / (2 * variance))
    return weights / jnp.sum(weights)


@ft.partial(jax.jit, static_argnames=("passes", "sampling"))
def _binomial_blur(image, weights, passes, sampling):
    return _repeated(lambda image: separable(sampling, image, weights, weights), image, passes)


@ft.partial(jax.jit, static_argnames=("taps", "passes", "sampling"))
def _gaussian_blur(image, sigma, taps, passes, sampling):
    one_pass = ft.partial(_gaussian_pass, sampling, taps, passes)
    return _repeated(lambda image: one_pass(image, sigma), image, passes)


def _repeated(one_pass, image, passes):
    """The image after all passes, computed in `working_dtype`."""
    working = image.astype(working_dtype(image.dtype))
    working = fori_loop(0, passes, lambda _, image: one_pass(image), working)
    return working.astype(image.dtype)


@ft.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _gaussian_pass(
    sampling: Sampling,
    taps: int,
    passes: int,
    image: Float[Array, "h w c"],
    sigma: Float[Array, ""],
) -> Float[Array, "h w c"]:
    """One of `passes`, which together have the standard deviation `sigma`."""
    weights = _gaussian_weights(taps, sigma, passes).astype(image.dtype)
    return separable(sampling, image, weights, weights)


@ft.partial(_gaussian_pass.defjvp, symbolic_zeros=True)
def _(sampling, taps, passes, primals, tangents):
    # The derivative by `sigma` is one image. Through the weights it would be one per tap.
    (image, sigma), (image_dot, sigma_dot) = primals, tangents
    out = _gaussian_pass(sampling, taps, passes, image, sigma)
    weights_of = lambda sigma: _gaussian_weights(taps, sigma, passes).astype(image.dtype)
    weights, slopes = jax.jvp(weights_of, (sigma,), (jnp.ones_like(sigma),))
    dot = filter_tangent(image_dot, weights, weights)
    if not isinstance(sigma_dot, SymbolicZero):
        # Apart: otherwise XLA gathers the rows once for all filters and keeps all copies.
        for pair in ((slopes, weights), (weights, slopes)):
            slope = apart(image, lambda pair=pair: separable("discrete", image, *pair))
            dot = dot + sigma_dot.astype(image.dtype) * slope
    return out, dot


@jax.jit
def _downsample(image, weights):
    dtype = image.dtype
    image = image.astype(working_dtype(dtype))
    weights = weights.astype(image.dtype)
    return _halved(_halved(image, weights, 0), weights, 1).astype(dtype)


def _halved(
    image: Float[Array, "h w c"], weights: Float[Array, "taps"], axis: int
) -> Float[Array, "H W c"]:
    """The image filtered and at half the size along an axis."""
    size, half = image.shape[axis], weights.size // 2 - 1
    margin = [(0, 0)] * 3
    margin[axis] = (half, half + size % 2)
    padded = jnp.pad(image, margin, mode="edge")
    length = padded.shape[axis] - 2 * half

    def tap(i: int) -> Array:
        return lax.slice_in_dim(padded, i, i + length - 1, 2, axis)

    return added(discrete_terms(weights, tap))
