"""Sums of many lights' terms per pixel, to which a light can be added or taken out again.

Two things keep long chains of edits exact. The sums are compensated: what rounding loses is
summed up beside them. And a light is added and taken out by one compiled loop, so both terms
are equal to the last bit.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._arguments import alike
from jaxfx._loops import scan
from jaxfx._xla import apart
from jaxfx.light import AmbientLight, Light
from jaxfx.relight.shading import (
    Surface,
    colored,
    in_shadow,
    received,
    stack_visibilities,
    with_reflectances,
)


_Image = Float[Array, "height width 3"]


class Sum(NamedTuple):
    """A compensated sum of images: the sum, and the sum of what rounding lost."""

    total: _Image
    lost: _Image


class Sums(NamedTuple):
    """The sums over all lights but ambient ones, in the order of `received`.

    `diffuse` and `specular` are before the reflectances multiply them. `grazing` is what GGX
    reflects whatever its reflectance, None where no pixel is of GGX. `nonfinite` counts, per
    pixel, the lights whose term is not finite. Those terms are left out of the sums: nothing
    could take them out again.
    """

    diffuse: Sum
    specular: Sum
    grazing: Sum | None
    nonfinite: Int[Array, "height width"]


def sums_of_none(surface: Surface) -> Sums:
    """The sums without any light."""
    zero = jnp.zeros_like(surface.position)
    grazing = None if surface.facing is None else Sum(zero, zero)
    return Sums(
        Sum(zero, zero), Sum(zero, zero), grazing, nonfinite=jnp.zeros_like(surface.shader)
    )


@jax.jit
def with_lights(surface, sums, lights, visibilities, signs):
    """The sums with each light's term times its sign, 1 to add or -1 to take out.

    One loop for each kind of light; ambient lights have no term.
    """
    for which in alike(lights, visibilities):
        if isinstance(lights[which[0]], AmbientLight):
            continue
        group = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(lights[i] for i in which))
        shadows = stack_visibilities([visibilities[i] for i in which], surface)
        step = lambda sums, term: (_with_term(surface, sums, *term), None)
        sums, _ = scan(step, sums, (group, shadows, signs[jnp.array(which)]))
    return sums


def _with_term(
    surface: Surface,
    sums: Sums,
    light: Light,
    visibility: Float[Array, "height width ..."] | None,
    sign: Float[Array, ""],
) -> Sums:
    """The sums with one light's term times `sign`."""
    # Each part is read several times below.
    again = jax.checkpoint(received, prevent_cse=False)
    unshadowed = apart(sign, lambda: again(surface, light))
    terms = colored(light, in_shadow(surface, light, unshadowed, visibility))
    terms = {index: term for index, term in enumerate(terms) if term is not None}
    are_finite = (jnp.isfinite(term).all(axis=-1) for term in terms.values())
    is_finite = functools.reduce(jnp.logical_and, are_finite)
    parts: list[Any] = [sums.diffuse, sums.specular, sums.grazing]
    for index, term in terms.items():
        parts[index] = _add(parts[index], jnp.where(is_finite[..., None], sign * term, 0))
    nonfinite = sums.nonfinite + jnp.where(is_finite, 0, sign).astype(jnp.int32)
    return Sums(parts[0], parts[1], parts[2], nonfinite)


def _add(to: Sum, term: _Image) -> Sum:
    """The sum with a term; what rounding lost is computed exactly (Knuth 1969)."""
    total = to.total + term
    added = total - to.total
    lost = (to.total - (total - added)) + (term - added)
    return Sum(total, to.lost + lost)


@jax.jit
def image_of(surface, sums, ambient):
    """The image: the sums times the reflectances, and the ambient lights.

    `ambient` holds pairs of a light and its visibility.
    """
    whole = lambda part: part.total + part.lost
    grazing = None if sums.grazing is None else whole(sums.grazing)
    image = with_reflectances(surface, whole(sums.diffuse), whole(sums.specular), grazing)
    for light, visibility in ambient:
        term = light.color[None, None] * surface.ambient
        image = image + (term if visibility is None else visibility[..., None] * term)
    image = jnp.where((sums.nonfinite > 0)[..., None], jnp.nan, image)
    return jnp.where((surface.shader < 0)[..., None], 0, image)
