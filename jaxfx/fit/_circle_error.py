"""Variances of a fitted lens by model error: wrong circles of confusion of an effect.

Noise is not what makes a fitted lens wrong. An effect draws a slanted surface, a small circle
or what an edge hides unlike a lens does, and the search makes up for it by another lens, so
that little of it stays in the residual: tiles of the image then agree on a wrong lens. So the
circles of confusion are taken to be drawn too large or too small, by an error that pixels of
about the same defocus share, and the lens moves as these errors ask.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx.fit._jackknife import principal


# The standard deviation of that error, as a ratio to a circle of confusion and in pixels, and
# the number of groups ("strata") by defocus, each of which has its own error. The ratio and
# the strata were chosen on 91 rooms of 64 x 48 pixels by `scatter`, then the least pixels with
# which 95 % intervals hold 95 % of the lenses of 44 of them, with better references;
# `python -m benchmarks.fit_coverage` measures it on others. Smaller errors or more strata state
# a lens as surer than it is, larger errors or fewer strata as less sure.
_RATIO, _PIXELS, _STRATA = 0.05, 0.28, 6

# The least circle of confusion that is drawn as a disc, in pixels.
_POINT = 1.0

# A ratio to the root mean square of `widening` below which a pixel shows no blur. Rounding lies
# below it, what blurs a texture above.
_SHOWN = 1e-4


@jax.jit
def variances(
    columns: Float[Array, "residual unknown"],
    widening: Float[Array, " residual"],
    defocus: Float[Array, "photograph height width"],
) -> Float[Array, " unknown"]:
    """The variances of a least-squares solution by errors of the circles of confusion.

    `columns` is the Jacobian at the solution, `widening` the derivative of the residual as all
    circles grow by one ratio, in its logarithm; `defocus` is NaN where it is missing.
    """
    channels = widening.size // defocus.size
    squares = jnp.sum(widening.reshape(*defocus.shape, channels) ** 2, axis=-1)
    stratum = strata(defocus, squares > _SHOWN**2 * jnp.mean(squares))
    block = jnp.repeat(stratum.reshape(-1), channels)
    circle = jnp.repeat(jnp.nan_to_num(jnp.abs(defocus)).reshape(-1), channels)
    absolute = _PIXELS * widening / jnp.maximum(circle, _POINT)
    axes = principal(columns)
    errors = jnp.concatenate(
        [
            jax.ops.segment_sum(axes.along * error[:, None], block, _STRATA)
            for error in (_RATIO * widening, absolute)
        ]
    )
    # The bound keeps what no pixel determines finite, and large.
    curvatures = jnp.maximum(axes.squares, 64 * jnp.finfo(columns.dtype).eps)
    moves = (errors / curvatures[None]) @ axes.basis.T
    return jnp.sum(moves**2, axis=0)


def strata(
    defocus: Float[Array, "photograph height width"],
    shows_blur: Bool[Array, "photograph height width"],
) -> Int[Array, "photograph height width"]:
    """The stratum of each pixel: sixths, by defocus, of a photograph's pixels that show a blur.

    Equal values share a stratum. What lies before and what lies behind the focus have errors of
    their own: only their difference moves a focus distance. So an even background must not
    count: if it were most of the image, all else would share one stratum. All photographs show
    one scene, so that a stratum has the same surfaces in each, and the same error.
    """
    defocus = jnp.nan_to_num(defocus)

    def ranked(own, counts):
        shares = jnp.arange(1, _STRATA, dtype=own.dtype) / _STRATA
        bounds = jnp.nanquantile(jnp.where(counts, own, jnp.nan), shares)
        return jnp.searchsorted(bounds, own.reshape(-1), side="right")

    return jax.vmap(ranked)(defocus, shows_blur).reshape(defocus.shape)
