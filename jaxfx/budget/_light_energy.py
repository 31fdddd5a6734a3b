"""What each light brings to each tile of an image alone, and what its shadow takes away."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfx.budget._tiles import tile_of, tile_sums
from jaxfx.light import Light
from jaxfx.relight.shading import Surface, ggx_kinds, reflected, to_surface


# The share of the error that left-out shadows may take, a ratio: the rest is for lights. A
# larger one leaves out more shadows and fewer lights.
_SHADOWS = 1 / 4


class Energy(NamedTuple):
    """What lights bring alone, in squared units of radiance, summed over tiles and channels.

    - `size`: the number of values of the image.
    - `energy`, `unshadowed`: with their shadows, and without.
    - `shadows`: by the index of each light with a shadow, the root mean square over the image
      of what that takes away.
    """

    size: int
    energy: Float[np.ndarray, "tile light"]
    unshadowed: Float[np.ndarray, "tile light"]
    shadows: dict[int, float]

    def free_shadows(self, max_error: float) -> tuple[list[int], float]:
        """The lights whose shadows are left out, and the error of that: those least first."""
        chosen, spent = [], 0.0
        for index in sorted(self.shadows, key=self.shadows.__getitem__):
            if spent + self.shadows[index] > _SHADOWS * max_error:
                break
            chosen.append(index)
            spent += self.shadows[index]
        return chosen, spent


def light_energy(gbuffer: Any, camera: Any, lights: Any, visibilities: Any) -> Energy:
    """The energy of each light, shaded once and alone."""
    size, tiles = gbuffer.color.size, 1 + tile_of(gbuffer.depth.shape)[-1]
    energy, unshadowed = np.zeros((2, tiles, len(lights)))
    shadows = {}
    for members in by_kind(lights, visibilities):
        some = [(lights[n], visibilities[n]) for n in members]
        squares = np.asarray(_squares(gbuffer, camera, some, ggx_kinds(gbuffer)), float)
        unshadowed[:, members], energy[:, members] = squares[0].T, squares[1].T
        if visibilities[members[0]] is not None:
            taken = np.sqrt(squares[2].sum(axis=1) / size)
            shadows |= dict(zip(members, taken.tolist(), strict=True))
    return Energy(size, energy, unshadowed, shadows)


def by_kind(lights: Sequence[Light], shadows: Sequence[Any]) -> list[list[int]]:
    """Indices of the lights of each kind, those with a shadow apart: each a program's loop."""
    kinds: dict[str, list[int]] = {}
    for index, (light, shadow) in enumerate(zip(lights, shadows, strict=True)):
        rows = getattr(light, "heights", ())
        kinds.setdefault(f"{type(light)} {rows} {shadow is None}", []).append(index)
    return [kinds[kind] for kind in sorted(kinds)]


def stacked(some: Sequence[Any], surface: Surface) -> tuple[Any, Any]:
    """Lights of a kind, stacked, and their shadows; None where none has a shadow."""
    lights, shadows = zip(*some, strict=True)
    together = lambda *x: jnp.stack([y.astype(surface.position.dtype) for y in x])
    lights = jax.tree.map(together, *lights)
    if all(shadow is None for shadow in shadows):
        return lights, None
    lit = jnp.ones_like(surface.position[..., 0])
    shadows = together(*(lit if shadow is None else jnp.asarray(shadow) for shadow in shadows))
    return lights, jnp.where((surface.shader < 0)[None], 0, shadows)


@partial(jax.jit, static_argnames="kinds")
def _squares(gbuffer, camera, some, kinds):
    """Sums of squares, light tile: without its shadow, with it, and of what that takes."""
    surface = to_surface(gbuffer, camera, kinds)

    def each(both):
        light, shadow = both
        reflected_image = reflected(surface, light)
        if shadow is None:
            return 2 * (tile_sums(reflected_image**2),)
        shadow = shadow[..., None]
        parts = reflected_image, reflected_image * shadow, reflected_image * (1 - shadow)
        return tuple(tile_sums(part**2) for part in parts)

    return jax.lax.map(each, stacked(some, surface))
