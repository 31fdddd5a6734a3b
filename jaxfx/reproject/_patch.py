"""Bilinear reads inside one surface: a texel that lies elsewhere in depth has no share."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._numerics import safe_divide


class Patch(NamedTuple):
    """The four texels about a point and their shares, those of others' surfaces 0.

    A texel whose share is 0 at this very point still has a say in the derivative; it is left
    out only where it is not finite.
    """

    rows: Int[Array, "4 ray"]
    columns: Int[Array, "4 ray"]
    shares: Float[Array, "4 ray"]

    def read(self, values: Float[Array, "height width"]) -> Float[Array, " ray"]:
        """The mean of the texels that have a share; 0 where none has."""
        total = jnp.zeros_like(self.shares[0])
        for row, column, share in zip(self.rows, self.columns, self.shares, strict=True):
            texel = values.at[row, column].get(mode="promise_in_bounds")
            total = total + share * _unless_unseen(texel, share)
        return safe_divide(total, jnp.sum(self.shares, axis=0))

    def read_colors(self, image: Float[Array, "height width channel"]) -> Float[Array, "..."]:
        """The same of every channel, ray channel.

        The loop keeps the patch in memory: fused, each channel would look for the hit anew.
        """

        def add(sums: tuple[Array, Array], texel: tuple[Array, Array, Array]) -> Any:
            (total, whole), (row, column, share) = sums, texel
            color = image.at[row, column].get(mode="promise_in_bounds")
            whole, share = whole + share, jnp.broadcast_to(share[:, None], color.shape)
            return (total + share * _unless_unseen(color, share), whole), None

        shares = self.shares.astype(image.dtype)
        total = jnp.zeros((shares.shape[1], image.shape[2]), image.dtype)
        sums = total, jnp.zeros_like(shares[0])
        (total, whole), _ = jax.lax.scan(add, sums, (self.rows, self.columns, shares))
        return safe_divide(total, jnp.broadcast_to(whole[:, None], total.shape))


def _unless_unseen(texel: Float[Array, "*shape"], share: Float[Array, "*shape"]) -> Array:
    return jnp.where((share > 0) | jnp.isfinite(texel), texel, 0)


def patch(
    depth: Float[Array, "height width"],
    x: Float[Array, " ray"],
    y: Float[Array, " ray"],
    anchor: Float[Array, " ray"],
    threshold: int | float | None,
) -> Patch:
    """The patch of texel centres about (x, y), of which those count that `anchor` is near.

    `threshold` is the step in depth, as a share of the nearer one, that parts surfaces, where
    depth is -1 / z; None for none, where all that are finite count.
    """
    height, width = depth.shape
    corner_x, corner_y = (jax.lax.stop_gradient(jnp.floor(v - 0.5)) for v in (x, y))
    along_x, along_y = x - 0.5 - corner_x, y - 0.5 - corner_y
    rows, columns, shares = [], [], []
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column = jnp.clip(corner_x + i, 0, width - 1).astype(jnp.int32)
        row = jnp.clip(corner_y + j, 0, height - 1).astype(jnp.int32)
        texel = jax.lax.stop_gradient(depth.at[row, column].get(mode="promise_in_bounds"))
        counts = texel < jnp.inf
        if threshold is not None:
            counts = counts & ~is_apart(texel, anchor, threshold)
        share = (along_x if i else 1 - along_x) * (along_y if j else 1 - along_y)
        rows.append(row)
        columns.append(column)
        shares.append(jnp.where(counts, share, 0))
    return Patch(jnp.stack(rows), jnp.stack(columns), jnp.stack(shares))


def is_apart(one: Array, other: Array, threshold: int | float) -> Array:
    """Whether two depths, as -1 / z, differ by more than a share of the nearer one."""
    nearer, farther = jnp.minimum(one, other), jnp.maximum(one, other)
    return farther - nearer > -threshold * farther
