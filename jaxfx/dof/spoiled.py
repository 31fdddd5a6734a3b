"""Pixels that a colour which is no number spoils: all that its sprite reaches."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._platform import by_platform, either
from jaxfx.dof.kernels._tiles import sum_all
from jaxfx.dof.sprites import POINT_RADIUS, reach, row_half_width


def spoiled(
    bad: Bool[Array, "height width"], coc: Float[Array, "height width"], max_coc: int | float
) -> Bool[Array, "height width"]:
    """Where the sprites of the `bad` pixels reach, `max_coc` where a circle is not known.

    If there are none, nothing is computed; in a batch, for no image that has none.
    """
    diameter = jnp.where(coc < max_coc, jnp.maximum(coc, 2 * POINT_RADIUS), max_coc)
    # The other pixels reach only themselves: the kernels then skip them.
    radius = jax.lax.stop_gradient(jnp.where(bad, diameter / 2, POINT_RADIUS))

    # Not by a `cond` alone, which under `vmap` becomes a `select`, and computes both sides.
    is_good = lambda bad, _: ~bad.any()
    found = ft.partial(_reached, reach(max_coc))
    return either(is_good, lambda bad, _: bad, found, bad, radius)


def _reached(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    return by_platform(
        bad, radius, cpu=ft.partial(_summed, far), accelerator=ft.partial(_grown, far)
    )


def _summed(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Where the sum of their sprites is not 0."""
    return sum_all(bad[..., None].astype(radius.dtype), radius, far)[..., 0] > 0


def _grown(
    far: int, bad: Bool[Array, "height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """The same in few launches: every row of every sprite at once, by doubling steps aside.

    `beyond` is how many columns beyond its pixel a row goes on, -1 where there is none of it.
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
    found = [tall[row, start : start + height] for row, start in offsets]
    return ft.reduce(jnp.maximum, found) >= 0
