"""The four searches under one call, whose cost under `vmap` is that of all rays together."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._platform import by_platform
from jaxfx.reproject import _march, _walk
from jaxfx.reproject._found import Found


SEARCHES = {
    "pyramid": _walk.walk,
    "descent": _march.descend,
    "linear": _march.linear,
    "relief": _march.relief,
}


def first_crossing(
    depth: Float[Array, "height width"],
    origin: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
    search: str,
    max_steps: int | None,
    *,
    from_end: bool = False,
) -> Found:
    """Where each ray first meets the depth, a texel of which is +inf where nothing is.

    Integer work: nothing is differentiated, and no derivative's pass meets its loops. When rays
    begin, `_grid.Rays` says. The time of a miss is 0: a derivative multiplies it by 0, and an
    infinite one would make that NaN.
    """
    held = map(jax.lax.stop_gradient, (depth, origin, direction))
    found = _searcher(search, max_steps, from_end)(*held)
    return found._replace(time=jnp.where(found.mask, found.time, 0))


_FOUND = jax.tree.structure(Found(*Found._fields))  # pyright: ignore[reportArgumentType]


@functools.cache
def _searcher(search: str, max_steps: int | None, from_end: bool):
    def alone(depth, origin, direction):
        return SEARCHES[search](depth, origin, direction, max_steps, from_end)

    one = jax.custom_batching.custom_vmap(alone)

    @one.def_vmap
    def many(size, batched, depth, origin, direction):
        is_batched = jax.tree.unflatten(_FOUND, [True] * len(Found._fields))
        each = lambda x, is_mapped: x if is_mapped else jnp.broadcast_to(x, (size, *x.shape))
        origin, direction = each(origin, batched[1]), each(direction, batched[2])
        if batched[0]:
            # On a CPU a loop under `vmap` would run every search as long as the longest.
            in_turn = lambda *args: jax.lax.map(lambda each: one(*each), args)
            at_once = jax.vmap(alone)
            args = depth, origin, direction
            return by_platform(*args, cpu=in_turn, accelerator=at_once), is_batched
        found = one(depth, origin.reshape(-1, 3), direction.reshape(-1, 3))
        return jax.tree.map(lambda x: x.reshape(size, -1), found), is_batched

    return one
