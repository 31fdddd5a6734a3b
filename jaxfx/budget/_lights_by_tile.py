"""A cheaper way to render many lights: each light only in tiles where it adds enough light."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfx._checks import as_array
from jaxfx._loops import scan
from jaxfx.budget._light_energy import Energy, by_kind, stacked
from jaxfx.budget._search import Search, Trial
from jaxfx.budget._tiles import Blocks, blocks, spend, tile_of
from jaxfx.relight.shading import ggx_kinds, reflected, to_surface


# A share of the tiles. A light that is needed in more of them than this is computed in all
# pixels: a pixel in a block takes about three times as long as one of the whole image.
_EVERYWHERE = 1 / 3


class Tiled(eqx.Module):
    """Some lights everywhere, others in some tiles, the rest nowhere.

    - `everywhere`: static; indices of the lights that are computed in all pixels.
    - `shadowed`: static; indices of the lights, of either kind, whose shadows are read.
    - `parts`: the lights that are computed in some tiles, with the pixels of these tiles.
    """

    everywhere: tuple[int, ...] = eqx.field(static=True)
    shadowed: tuple[int, ...] = eqx.field(static=True)
    parts: tuple[Blocks, ...]
    title: ClassVar[str] = "relighting, tile by tile"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """The image, called like `relight.render`."""

        # Picked outside of the compiled program, which then serves any choice of lights.
        name = "relight(visibilities)"
        read = {n: as_array(name, visibilities[n]) for n in self.shadowed}
        chosen = lambda members: [(lights[n], read.get(n)) for n in members]
        parts = [(chosen(part.members), part.item, part.pixels) for part in self.parts]
        return _tiled(gbuffer, camera, chosen(self.everywhere), parts, ggx_kinds(gbuffer))


def try_tiles(search: Search, brought: Energy) -> None:
    """Try to leave out, tile by tile, the lights that bring least."""
    free, spent = brought.free_shadows(search.max_error)
    shadowed = tuple(index for index in brought.shadows if index not in free)
    is_free = np.isin(np.arange(brought.energy.shape[1]), free)
    energy = np.where(is_free[None], brought.unshadowed, brought.energy)
    order = np.argsort(energy, axis=1)
    # An energy is the square of a norm, and the norm of a sum is at most the sum of the norms.
    # So this bounds the energy that a tile lacks without its 1, 2, ... weakest lights.
    missing = np.cumsum(np.sqrt(np.take_along_axis(energy, order, axis=1)), axis=1) ** 2
    squares = np.pad(missing, ((0, 0), (1, 0)))
    left_out = spend(squares, search.max_error - spent, brought.size)
    # In each tile, the `left_out` weakest lights are left out.
    uses = (np.argsort(order, axis=1) >= left_out[:, None]).T
    share = uses.mean(axis=1)
    everywhere = np.flatnonzero(share > _EVERYWHERE)
    parts = np.where((share > _EVERYWHERE)[:, None], False, uses)
    if len(everywhere) == len(uses) and not free:
        return
    alone = np.sqrt(energy.sum(axis=0) / brought.size)
    texts = []
    if len(idle := np.flatnonzero(share == 0)):
        texts.append(f"{_named('light', idle.tolist())}, {alone[idle].sum():.2g} at most")
    if len(some := np.flatnonzero(parts.any(axis=1))):
        outside = 1 - share[some].mean()
        texts.append(f"{_named('light', some.tolist())} in {outside:.0%} of their tiles")
    if free:
        texts.append(f"{_named('shadow', sorted(free))}, {spent:.2g} at most")
    lights = search.data[2]
    pixels = blocks(parts[:, tile_of(search.data[0].depth.shape)], lights)
    reads = tuple(n for n in shadowed if share[n] > 0)
    candidate = Tiled(tuple(everywhere.tolist()), reads, pixels)
    # The work is estimated, as a ratio of that of all lights everywhere. The candidate is only
    # measured if that is less than the time of each earlier candidate within the allowed error.
    work = float(np.minimum(share / _EVERYWHERE, 1).mean())
    earlier_times = [trial.time for trial in search.tried if trial.error <= search.max_error]
    if work < min(earlier_times, default=1):
        search.measure(candidate, "; ".join(texts))
    else:
        search.tried.append(Trial(candidate, "; ".join(texts), (), work))


def _named(kind: str, indices: Sequence[Any]) -> str:
    """ "light 1" or "lights 1, 2"."""
    numbers = ", ".join(str(index) for index in indices)
    return f"{kind}{'s' if len(indices) > 1 else ''} {numbers}"


@partial(jax.jit, static_argnames="kinds")
def _tiled(gbuffer, camera, everywhere, parts, kinds):
    """The image of lights and their shadows everywhere, and of those in blocks of pixels."""
    surface = to_surface(gbuffer, camera, kinds)
    image = jnp.zeros_like(surface.position)
    recomputed = jax.checkpoint(reflected, prevent_cse=False)

    def add(image, each):
        light, shadow = each
        part = recomputed(surface, light)
        return image + (part if shadow is None else part * shadow[..., None]), None

    for members in by_kind(*zip(*everywhere, strict=True)) if everywhere else []:
        some = [everywhere[n] for n in members]
        image, _ = scan(add, image, stacked(some, surface))

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), surface)
    pixels = image.reshape(-1, 3)
    for chosen, *of_each in parts:
        lights, shadows = stacked(chosen, surface)

        @jax.checkpoint
        def block(pixels, each, lights=lights, shadows=shadows):
            # Indices beyond the image fill up a block: they read anything and write nothing.
            item, where = each
            here = jax.tree.map(lambda x: x.at[where].get(mode="clip")[None], flat)
            shown = reflected(here, jax.tree.map(lambda x: x[item], lights))[0]
            if shadows is not None:
                shadow = shadows[item].reshape(-1).at[where].get(mode="clip")
                shown = shown * shadow[:, None]
            return pixels.at[where].add(shown, mode="drop"), None

        pixels, _ = scan(block, pixels, tuple(of_each))
    return pixels.reshape(image.shape).astype(gbuffer.color.dtype)
