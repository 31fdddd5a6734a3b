"""What a target camera sees of a source's depth: the geometry that `warp` and others share."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._numerics import safe_divide
from jaxfx.camera import PinholeCamera
from jaxfx.reproject._found import START, TOP, X_SIDE, Y_SIDE, Found
from jaxfx.reproject._patch import Patch, is_apart, patch
from jaxfx.reproject._rays import Camera, view_rays
from jaxfx.reproject._search import search
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
    method: str,
    hole_threshold: int | float,
    max_steps: int | None = None,
) -> View:
    """The source's pixels that some of the target's pixels see, and 1 / z in the source."""
    height, width = depth.shape
    known = depth > 0
    inverse = -safe_divide(jnp.ones_like(depth), jnp.where(known, depth, 1))
    field = jnp.where(known, inverse, jnp.inf)
    nearest = jax.lax.stop_gradient(jnp.min(jnp.where(known, depth, jnp.inf)))
    near = jnp.where(nearest < jnp.inf, nearest / 2, 1)
    rays = view_rays(source, target, pixels, shape=(height, width), near=near)
    found = search(field, rays.origin, rays.direction, method, max_steps)
    # A ray that ends at infinity meets what lies there, and nothing beyond.
    ends = found.time <= 1 + 64 * jnp.finfo(depth.dtype).eps
    found = found._replace(mask=found.mask & rays.inside & ends)
    unseen = _is_unseen(
        jax.lax.stop_gradient(field), rays.origin, rays.direction, found, hole_threshold
    )
    point = bilinear_point(field, rays.origin, rays.direction, found, hole_threshold)
    x, y, z = jnp.moveaxis(point.position, -1, 0)
    anchor = jnp.where(found.mask, jax.lax.stop_gradient(field)[found.y, found.x], 0)
    seen = found.mask & ~unseen
    shown = patch(field, x, y, anchor, hole_threshold)
    shown = shown._replace(shares=jnp.where(seen[None], shown.shares, 0))
    return View(jnp.stack([x, y], axis=-1), -z, seen, shown, found.steps)


def _is_unseen(
    field: Array, origin: Array, direction: Array, found: Found, threshold: int | float
) -> Bool[Array, " ray"]:
    """Whether a ray went in through a wall, which the source had no sight of.

    A wall is a step in depth from the texel before to the one that is hit. A ray that is behind
    the depth where it comes into the frustum has passed a surface that is not in the picture.
    """
    height, width = field.shape
    back_x = jnp.where(found.side == X_SIDE, -jnp.sign(direction[:, 0]), 0).astype(jnp.int32)
    back_y = jnp.where(found.side == Y_SIDE, -jnp.sign(direction[:, 1]), 0).astype(jnp.int32)
    x, y = found.x + back_x, found.y + back_y
    exists = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (found.side != START)
    before = field[jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)]
    here = jnp.where(found.mask, field[found.y, found.x], 0)
    ray = jax.lax.stop_gradient(origin[:, 2] + found.time * direction[:, 2])
    # Where nothing is before, or the search errs, the ray tells how far behind it came in.
    behind = jnp.where((before < jnp.inf) & (found.side != TOP), before, ray)
    rounding = 64 * jnp.finfo(field.dtype).eps * jnp.abs(here)
    wall = (behind > here) & is_apart(here, behind, threshold)
    return jnp.where(exists, wall, ray > here + rounding)
