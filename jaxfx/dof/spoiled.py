"""Pixels that are spoilt by a colour that is not finite: those that its sprite reaches."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._platform import by_platform, either, kept
from jaxfx.dof.kernels._tiles import sum_all
from jaxfx.dof.sprites import POINT_RADIUS, reach, row_half_width


def spoiled(
    bad: Bool[Array, "height width"], coc: Float[Array, "height width"], max_coc: int | float
) -> Bool[Array, "height width"]:
    """The pixels that sprites of the `bad` pixels reach.

    A circle of confusion that is NaN or too large counts as `max_coc`. If no pixel is bad,
    nothing is computed; in a batch, nothing for images that have none.
    """
    diameter = jnp.where(coc < max_coc, jnp.maximum(coc, 2 * POINT_RADIUS), max_coc)
    # The other pixels reach only themselves: the kernels then skip them.
    radius = jax.lax.stop_gradient(jnp.where(bad, diameter / 2, POINT_RADIUS))

    # Not by a `cond` alone, which under `vmap` becomes a `select`, and computes both sides.
    # Kept in memory. Otherwise an accelerator joins `any` with all that leads to `bad` in one
    # kernel, which takes a second to compile.
    is_good = lambda bad, _: ~kept(bad).any()
    cover = ft.partial(_reached, reach(max_coc))
    return either(is_good, lambda bad, _: bad, cover, bad, radius)


def _reached(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    return by_platform(
        bad, radius, cpu=ft.partial(_summed, far), accelerator=ft.partial(_grown, far)
    )


def _summed(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """The pixels at which the sum of the bad sprites is not 0."""
    return sum_all(bad[..., None].astype(radius.dtype), radius, far)[..., 0] > 0


def _grown(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """The same in few launches: all rows of all sprites at once, by doubling steps sideways.

    `beyond` is, per row of a sprite, how many columns it extends beyond its pixel to either
    side, or -1 where the sprite has no such row.
    """
    height, width = bad.shape
    rows = jnp.arange(far + 1).astype(radius.dtype)  # a sprite is its own mirror image
    half = jax.vmap(row_half_width, (None, 0))(radius, rows)
    beyond = jnp.where(bad[None] & (half > 0), jnp.ceil(half + 0.5) - 1, -1).astype(jnp.int16)
    step = 1
    while step <= far:
        wide = jnp.pad(beyond, ((0, 0), (0, 0), (step, step)), constant_values=-1)
        beside = jnp.maximum(wide[..., :width], wide[..., 2 * step :])
        beyond, step = jnp.maximum(beyond, beside - step), 2 * step
    tall = jnp.pad(beyond, ((0, 0), (far, far), (0, 0)), constant_values=-1)
    offsets = [(abs(row), row + far) for row in range(-far, far + 1)]
    shifted = [tall[row, start : start + height] for row, start in offsets]
    return ft.reduce(jnp.maximum, shifted) >= 0
