"""What many lights bring to a surface, as sums that a light can be taken out of again.

Two things keep a long chain of changes true. The sums carry along what rounding takes from
them; and what is put in and what is taken out pass through the same compiled loop, and so are
the same to the last bit.
"""

from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx.light import AmbientLight, Light
from jaxfx.relight.shading import Surface, received, seen, stacked


_Image = Float[Array, "height width 3"]


class Sum(NamedTuple):
    """A sum of images, and the sum of what rounding took from it."""

    total: _Image
    lost: _Image


class Sums(NamedTuple):
    """What the lights bring, but for ambient ones.

    `spoiled` counts the lights that bring a pixel something that is not finite. They are left
    out of the sums, or nothing would take them out again.
    """

    diffuse: Sum
    specular: Sum
    spoiled: Int[Array, "height width"]


def nothing(surface: Surface) -> Sums:
    """The sums of no lights."""
    zero = jnp.zeros_like(surface.position)
    return Sums(Sum(zero, zero), Sum(zero, zero), jnp.zeros_like(surface.shader))


@jax.jit
def changed(surface, sums, lights, visibility, signs):
    """The sums with each light's share times its sign: one loop for each kind of light."""
    for kind in get_args(Light):
        which = [i for i, light in enumerate(lights) if isinstance(light, kind)]
        if not which or kind is AmbientLight:
            continue
        group = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(lights[i] for i in which))
        shadows = stacked([visibility[i] for i in which], surface)
        step = lambda sums, term: (_with_term(surface, sums, *term), None)
        sums, _ = jax.lax.scan(step, sums, (group, shadows, signs[jnp.array(which)]))
    return sums


def _with_term(
    surface: Surface,
    sums: Sums,
    light: Light,
    visibility: Float[Array, "height width"] | None,
    sign: Float[Array, ""],
) -> Sums:
    shares = jax.checkpoint(received, prevent_cse=False)(surface, light)
    shares = tuple(seen(surface, share, visibility) for share in shares)
    # Each is read several times below. On a CPU, XLA of jaxlib 0.12 computes them once, with
    # a third less work; that of 0.10 drops the barrier and computes them again for each.
    diffuse, specular = jax.lax.optimization_barrier(shares)
    finite = jnp.isfinite(diffuse).all(axis=-1) & jnp.isfinite(specular).all(axis=-1)
    signed = lambda share: jnp.where(finite[..., None], sign * share, 0)
    return Sums(
        _add(sums.diffuse, signed(diffuse)),
        _add(sums.specular, signed(specular)),
        sums.spoiled + jnp.where(finite, 0, sign).astype(jnp.int32),
    )


def _add(to: Sum, term: _Image) -> Sum:
    """The sum and what it lost, exactly."""
    total = to.total + term
    added = total - to.total
    lost = (to.total - (total - added)) + (term - added)
    return Sum(total, to.lost + lost)


@jax.jit
def image(surface, sums, ambient):
    """The picture: the sums times what the surface reflects, ambient light added."""
    diffuse, specular = (part.total + part.lost for part in (sums.diffuse, sums.specular))
    image = surface.diffuse * diffuse + surface.specular * specular
    for light, visible in ambient:
        share = light.color[None, None] * surface.ambient
        image = image + (share if visible is None else visible[..., None] * share)
    image = jnp.where((sums.spoiled > 0)[..., None], jnp.nan, image)
    return jnp.where((surface.shader < 0)[..., None], 0, image)
