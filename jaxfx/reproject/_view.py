"""What a target camera sees of a source's depth: the geometry that `warp` and others share."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx.camera import PinholeCamera
from jaxfx.reproject._found import TOP, X_SIDE, Y_SIDE, Found
from jaxfx.reproject._grid import start
from jaxfx.reproject._patch import Patch, is_apart, patch
from jaxfx.reproject._rays import Camera, view_rays
from jaxfx.reproject._search import first_crossing
from jaxfx.reproject._surface import bilinear_point


class View(NamedTuple):
    """For each of the target's pixels: what it shows of the source, and whether it does.

    Where it shows nothing, no texel of the patch has a share. With it, how long the search was.
    """

    pixels: Float[Array, "ray 2"]
    inverse_depth: Float[Array, " ray"]
    mask: Bool[Array, " ray"]
    patch: Patch
    steps: Int[Array, " ray"]


@eqx.filter_jit
def look(
    depth: Float[Array, "height width"],
    source: PinholeCamera,
    target: Camera,
    pixels: Float[Array, "ray 2"],
    *,
    search: str,
    hole_threshold: int | float,
    max_steps: int | None = None,
) -> View:
    """The source's pixels that some of the target's pixels see, and 1 / z in the source."""
    height, width = depth.shape
    known, hold = depth > 0, jax.lax.stop_gradient
    nearest = hold(jnp.min(jnp.where(known, depth, jnp.inf)))
    # Half of the nearest depth: where the frustum begins, and the unit of all lengths below.
    least = jnp.finfo(depth.dtype).tiny
    unit = jnp.where(nearest < jnp.inf, jnp.maximum(nearest / 2, least), 1)
    field = jnp.where(known, -1 / jnp.where(known, depth / unit, 1), jnp.inf)
    rays = view_rays(source, target, pixels, shape=(height, width), unit=unit)
    line = rays.origin, rays.direction
    found = first_crossing(field, *line, search, max_steps, from_end=True)
    # A ray that ends at infinity meets what lies there, and nothing beyond.
    in_front = hold(line[0][:, 2] + found.time * line[1][:, 2]) <= 0
    found = found._replace(mask=found.mask & rays.inside & in_front)
    unseen = _is_unseen(hold(field), *hold(line), found, hole_threshold)
    point = bilinear_point(field, *line, found, hole_threshold, from_end=True)
    x, y, z = jnp.moveaxis(point.position, -1, 0)
    column, row = (
        jnp.clip(jnp.floor(v), 0, size - 1).astype(jnp.int32)
        for v, size in ((x, width), (y, height))
    )
    anchor = jnp.where(found.mask, hold(field)[found.y, found.x], 0)
    # The patch of a surface reaches into a hole beside it, the surface does not.
    seen = found.mask & ~unseen & known[row, column]
    shown = patch(field, x, y, anchor, hole_threshold)
    shown = shown._replace(shares=jnp.where(seen[None], shown.shares, 0))
    return View(jnp.stack([x, y], axis=-1), -z / unit, seen, shown, found.steps)


def _is_unseen(
    field: Array, origin: Array, direction: Array, found: Found, threshold: int | float
) -> Bool[Array, " ray"]:
    """Whether a ray went in through a wall, which the source had no sight of.

    A wall is a step in depth from the texel before to the one that is hit. A ray that is behind
    the depth where it comes into the frustum, or out of a hole, has passed a surface that is
    not in the picture.
    """
    height, width = field.shape
    back_x = jnp.where(found.side == X_SIDE, -jnp.sign(direction[:, 0]), 0).astype(jnp.int32)
    back_y = jnp.where(found.side == Y_SIDE, -jnp.sign(direction[:, 1]), 0).astype(jnp.int32)
    x, y = found.x + back_x, found.y + back_y
    kind = jnp.finfo(field.dtype)
    per_texel = jnp.maximum(jnp.abs(direction[:, 0]), jnp.abs(direction[:, 1]))
    way = (found.time - start(direction[:, 2], from_end=True)) * per_texel
    begins = (way <= 64 * kind.eps * max(height, width)) & (found.side != TOP)
    exists = (x >= 0) & (x < width) & (y >= 0) & (y < height) & ~begins
    before = field[jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)]
    here = jnp.where(found.mask, field[found.y, found.x], 0)
    # No nearer to the eye than this, as its two terms are rounded and may cancel.
    along = found.time * direction[:, 2]
    rounding = 64 * kind.eps * (jnp.abs(origin[:, 2]) + jnp.abs(along)) + kind.tiny
    ray = origin[:, 2] + along - rounding
    # A search that errs reaches a top from behind it: the ray tells how far.
    behind = jnp.where(found.side == TOP, ray, before)
    wall = (behind > here) & is_apart(here, behind, threshold)
    return jnp.where(exists & (before < jnp.inf), wall, ray > here)
