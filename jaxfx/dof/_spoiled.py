"""Pixels that a colour which is no number spoils: all that its sprite reaches."""

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float

from jaxfx.dof._sprites import POINT_RADIUS, reach
from jaxfx.dof._tiles import sum_all


def spoiled(
    bad: Bool[Array, "height width"], coc: Float[Array, "height width"], max_coc: int | float
) -> Bool[Array, "height width"]:
    """Where the sprites of the `bad` pixels reach, `max_coc` where a circle is not known.

    If there are none, nothing is computed; in a batch, for no image that has none.
    """
    diameter = jnp.where(coc < max_coc, jnp.maximum(coc, 2 * POINT_RADIUS), max_coc)
    # The other pixels reach only themselves: the kernels then skip them.
    radius = jax.lax.stop_gradient(jnp.where(bad, diameter / 2, POINT_RADIUS))

    # One by one: under `vmap` a `cond` by itself becomes a `select`, and computes both sides.
    @sequential_vmap
    def reached(bad, radius):
        return jax.lax.cond(bad.any(), cover, lambda bad, _: bad, bad, radius)

    def cover(bad, radius):
        value = bad[..., None].astype(radius.dtype)
        return sum_all(value, radius, reach(max_coc))[..., 0] > 0

    return reached(bad, radius)
