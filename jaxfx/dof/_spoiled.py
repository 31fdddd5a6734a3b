"""What the pixels spoil that are no picture: all that their sprites reach."""

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Bool, Float

from jaxfx.dof._sprites import POINT_RADIUS, reach
from jaxfx.dof._tiles import sum_all
from jaxfx.lens import FocusPlanes, ThinLens


def spoiled(
    bad: Bool[Array, "height width"],
    depth: Float[Array, "height width"],
    lens: ThinLens | FocusPlanes,
    max_coc: int | float,
) -> Bool[Array, "height width"]:
    """Where the sprites of the `bad` pixels reach, the largest where a depth is no depth.

    If there are none, nothing is computed; in a batch, for no image that has none.
    """
    coc = lens.circle_of_confusion(depth)
    is_known = (coc < max_coc) & (depth >= 0)
    diameter = jnp.where(is_known, jnp.maximum(coc, 2 * POINT_RADIUS), max_coc)
    # What the other pixels reach costs nothing then.
    radius = jax.lax.stop_gradient(jnp.where(bad, diameter / 2, POINT_RADIUS))

    # One by one: under `vmap` a `cond` by itself becomes a `select`, and computes both sides.
    @sequential_vmap
    def found(bad, radius):
        return jax.lax.cond(bad.any(), cover, lambda bad, _: bad, bad, radius)

    def cover(bad, radius):
        value = bad[..., None].astype(radius.dtype)
        return sum_all(value, radius, reach(max_coc))[..., 0] > 0

    return found(bad, radius)
