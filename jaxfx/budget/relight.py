"""Lights within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from jaxfx._numerics import working_dtype
from jaxfx.budget._plan import Plan, Search, check_call, root_mean_square
from jaxfx.budget._tiles import Blocks, blocks, spend, sums, tile_of
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import AmbientLight, DirectionalLight, Light, PointLight
from jaxfx.relight.shading import reflected, render, shade, to_surface
from jaxfx.relight.state import start


# A light that is needed in more of the picture is computed in all of it: single pixels cost so
# many times as much.
_EVERYWHERE = 1 / 3
# The share of the error that shadows may take.
_SHADOWS = 1 / 4
# What of a light of each kind tells how near it is to another.
_PLACE = {AmbientLight: None, DirectionalLight: "direction", PointLight: "position"}


class Everything(eqx.Module):
    """All lights and all shadows."""

    title: ClassVar[str] = "relighting"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """As the effect."""
        if visibilities is None:
            return render(gbuffer, camera, lights)
        return start(gbuffer, camera, lights, visibilities=visibilities).image


class Tiled(eqx.Module):
    """Some lights everywhere, others in some tiles, the rest nowhere.

    - `everywhere`, `shadowed`: static; which lights are for all pixels, whose shadows are read.
    - `parts`: the pixels of the others.
    """

    everywhere: tuple[int, ...] = eqx.field(static=True)
    shadowed: tuple[int, ...] = eqx.field(static=True)
    parts: tuple[Blocks, ...]
    title: ClassVar[str] = "relighting, tile by tile"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """As the effect."""

        # Out here: the program does not know which lights these are.
        def chosen(members):
            shadows = [
                jnp.asarray(visibilities[n]) if n in self.shadowed else None for n in members
            ]
            return list(zip((lights[n] for n in members), shadows, strict=True))

        parts = [(chosen(part.members), part.item, part.pixels) for part in self.parts]
        return _tiled(gbuffer, camera, chosen(self.everywhere), parts)


class Merged(eqx.Module):
    """Every group of lights as one: as bright as all, in their mean place by brightness."""

    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    shadowed: tuple[int, ...] = eqx.field(static=True)
    title: ClassVar[str] = "relighting by merged lights"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """As the effect."""
        merged = [_merged([lights[index] for index in group]) for group in self.groups]
        if not self.shadowed:
            return render(gbuffer, camera, merged)
        first = [group[0] for group in self.groups]
        visible = [visibilities[n] if n in self.shadowed else None for n in first]
        return start(gbuffer, camera, merged, visibilities=visible).image


def relight(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    max_error: int | float,
    visibilities: Sequence[Float[ArrayLike, "height width"] | None] | None = None,
) -> Plan:
    """The fewest lights within an error of `relight.render` under all of them.

    Each light is shaded once, alone. What it brings to a tile of 8 x 8 pixels bounds what is
    missing there without it; lights are left out tile by tile, over the whole picture those
    first that bring least, for as long as the sum of the bounds is within the error. One that
    is needed in a few tiles is computed in these. A light whose shadow takes next to nothing
    away does without: its shadow map need not be made.

    Apart from that, lights are merged: of one kind those first that are dim and near, into half
    as many, a quarter, and so on, for as long as the picture is within the error. The quicker
    of the two ways is taken.

    It costs a rendering of each light alone, and one by each way.

    **Arguments:**

    - `gbuffer`, `camera`: as in `relight.render`, height width.
    - `lights`: a sequence of lights of any kinds.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `visibilities`: as in `relight.start`: for each light height width in [0, 1], or None if
      it has no shadows. None alone stands for no shadows at all.

    **Returns:** a `Plan`, to be called with `gbuffer, camera, lights` and, where there are
    shadows, `visibilities`: as many as there are here, None for those that are left out.

    **Raises:** `ValueError` as `relight.start`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice. The plan's picture has that of `relight.render` in
    the lights that are kept or merged; in the others it is zero.

    Source: tiles with their own lights are Olsson & Assarsson's 2011, tiled shading; one light
    for a near and dim group is Walter et al.'s 2005, lightcuts.
    """
    data = (gbuffer, camera, tuple(lights))
    data = data if visibilities is None else (*data, tuple(visibilities))
    data = (gbuffer, camera, tuple(lights))
    data = data if visibilities is None else (*data, tuple(visibilities))
    max_error = check_call("relight", max_error, data)
    search = Search(Everything(), data, max_error)
    if lights:
        brought = _bring(gbuffer, camera, lights, visibilities or [None] * len(lights))
        _try_merging(search, brought, lights)
        _try_tiles(search, brought)
    return search.plan()


class _Brought(NamedTuple):
    """What lights bring alone, as sums of squares over tiles, and what their shadows take."""

    tile: Int[np.ndarray, " pixel"]
    size: int
    energy: Float[np.ndarray, "tile light"]
    lit: Float[np.ndarray, "tile light"]
    shadows: dict[int, float]

    def free(self, max_error: float) -> tuple[list[int], float]:
        """The lights whose shadows together take no more than their share, and how much."""
        chosen, spent = [], 0.0
        for index in sorted(self.shadows, key=self.shadows.__getitem__):
            if spent + self.shadows[index] > _SHADOWS * max_error:
                break
            chosen.append(index)
            spent += self.shadows[index]
        return chosen, spent


def _bring(gbuffer: Any, camera: Any, lights: Any, visibilities: Any) -> _Brought:
    tile = tile_of(gbuffer.depth.shape)
    squares = lambda image: sums(
        np.square(np.asarray(image, float)).sum(-1).reshape(1, -1), tile
    )
    lit, dark, shadows = [], [], {}
    for index, (light, visible) in enumerate(zip(lights, visibilities, strict=True)):
        picture = shade(gbuffer, camera, light)
        lit.append(squares(picture))
        dark.append(lit[-1])
        if visible is not None:
            shaded = shade(gbuffer, camera, light, visible)
            dark[-1] = squares(shaded)
            shadows[index] = root_mean_square(picture - shaded)
    size = gbuffer.color.size
    beside = lambda columns: np.concatenate(columns, axis=1)
    return _Brought(tile, size, beside(dark), beside(lit), shadows)


def _try_tiles(search: Search, brought: _Brought) -> None:
    """Try to leave out, tile by tile, the lights that bring least."""
    free, spent = brought.free(search.max_error)
    shadowed = tuple(index for index in brought.shadows if index not in free)
    is_free = np.isin(np.arange(brought.energy.shape[1]), free)
    energy = np.where(is_free[None], brought.lit, brought.energy)
    order = np.argsort(energy, axis=1)
    # Lights that bring amounts a, b, ... bring no more than a + b + ... together.
    missing = np.cumsum(np.sqrt(np.take_along_axis(energy, order, axis=1)), axis=1) ** 2
    squares = np.pad(missing, ((0, 0), (1, 0)))
    fewest = spend(squares, search.max_error - spent, brought.size)
    # Each light's place from the dimmest on: as many as are spent are left out.
    uses = (np.argsort(order, axis=1) >= fewest[:, None]).T
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
    lights = search.whole[0].data[2]
    pixels = blocks(parts[:, brought.tile], lights)
    reads = tuple(n for n in shadowed if share[n] > 0)
    search.trial(Tiled(tuple(everywhere.tolist()), reads, pixels), "; ".join(texts))


def _named(kind: str, indices: Sequence[Any]) -> str:
    numbers = ", ".join(str(index) for index in indices)
    return f"{kind}{'s' if len(indices) > 1 else ''} {numbers}"


def _try_merging(search: Search, brought: _Brought, lights: Sequence[Light]) -> None:
    """Try half as many lights, a quarter, and so on, for as long as that will do."""
    free, _ = brought.free(search.max_error)
    shadowed = tuple(index for index in brought.shadows if index not in free)
    alone = [index for index, light in enumerate(lights) if type(light) not in _PLACE]
    groups: dict[tuple[int, ...], _Place]
    groups = {(index,): _Place.of(light) for index, light in enumerate(lights)}
    wanted = len(groups) // 2
    while wanted:
        before = len(groups)
        while len(groups) > wanted and (pair := _nearest(groups, {*shadowed, *alone})):
            one, other = (groups.pop(group) for group in pair)
            groups[tuple(sorted(pair[0] + pair[1]))] = one.joined(other)
        if len(groups) == before:
            return
        text = f"what {len(lights)} lights have beyond {len(groups)} merged ones"
        if search.trial(Merged(tuple(sorted(groups)), shadowed), text).error > search.max_error:
            return
        wanted = len(groups) // 2


class _Place(NamedTuple):
    """Where a light is, and how bright."""

    kind: type
    where: Float[np.ndarray, "3"]
    bright: float

    @classmethod
    def of(cls, light: Light) -> "_Place":
        name = _PLACE.get(type(light))
        where = np.asarray(getattr(light, name), float) if name else np.zeros(3)
        return cls(type(light), where, float(jnp.abs(light.color).sum()))

    def joined(self, other: "_Place") -> "_Place":
        """Both, in their mean place."""
        total = self.bright + other.bright
        share = other.bright / total if total else 0.5
        return _Place(self.kind, (1 - share) * self.where + share * other.where, total)


def _nearest(groups: dict[tuple[int, ...], _Place], apart: set[int]) -> Any:
    """The two groups of one kind that lose least by joining; None if there are none."""
    keys = [group for group in groups if group[0] not in apart]
    kind = np.array([list(_PLACE).index(groups[key].kind) for key in keys])
    where = np.array([groups[key].where for key in keys]).reshape(-1, 3)
    bright = np.array([groups[key].bright for key in keys])
    far = np.square(where[:, None] - where[None]).sum(axis=-1)
    total = np.maximum(bright[:, None] + bright[None], np.finfo(float).tiny)
    lost = far * bright[:, None] * bright[None] / total
    lost[(kind[:, None] != kind[None]) | np.tri(len(keys), dtype=bool)] = np.inf
    if not np.isfinite(lost).any():
        return None
    one, other = np.unravel_index(np.argmin(lost), lost.shape)
    return keys[one], keys[other]


def _merged(lights: Sequence[Any]) -> Any:
    """One light for several of a kind."""
    if len(lights) == 1:
        return lights[0]
    dtype = working_dtype(*(leaf.dtype for leaf in jax.tree.leaves(lights)))
    all_of_them = jax.tree.map(lambda *x: jnp.stack([y.astype(dtype) for y in x]), *lights)
    bright = jnp.sum(all_of_them.color, axis=-1)
    total = jnp.sum(bright)
    share = jnp.where(total > 0, bright / jnp.where(total > 0, total, 1), 1 / len(lights))
    mean = jax.tree.map(lambda x: jnp.tensordot(share, x, 1), all_of_them)
    return eqx.tree_at(lambda light: light.color, mean, jnp.sum(all_of_them.color, axis=0))


@jax.jit
def _tiled(gbuffer, camera, everywhere, parts):
    """The picture by lights and their shadows, and by those that are for some pixels."""
    surface = to_surface(gbuffer, camera)
    image = jnp.zeros_like(surface.position)
    again = jax.checkpoint(reflected, prevent_cse=False)

    def stacked(some):
        """Lights and, where one has a shadow, the shadows of all."""
        lights, shadows = zip(*some, strict=True)
        together = lambda *x: jnp.stack([y.astype(image.dtype) for y in x])
        lights = jax.tree.map(together, *lights)
        if all(shadow is None for shadow in shadows):
            return lights, None
        lit = jnp.ones(surface.shader.shape, image.dtype)
        shadows = together(*(lit if shadow is None else shadow for shadow in shadows))
        return lights, jnp.where((surface.shader < 0)[None], 0, shadows)

    def add(image, each):
        light, shadow = each
        part = again(surface, light)
        return image + (part if shadow is None else part * shadow[..., None]), None

    kinds = {(type(light), shadow is None) for light, shadow in everywhere}
    for kind in sorted(kinds, key=str):
        some = [each for each in everywhere if (type(each[0]), each[1] is None) == kind]
        image, _ = jax.lax.scan(add, image, stacked(some))

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), surface)
    pixels = image.reshape(-1, 3)
    for some, *of_each in parts:
        lights, shadows = stacked(some)

        @jax.checkpoint
        def block(pixels, each, lights=lights, shadows=shadows):
            item, where = each
            here = jax.tree.map(lambda x: x.at[where].get(mode="clip")[None], flat)
            shown = reflected(here, jax.tree.map(lambda x: x[item], lights))[0]
            if shadows is not None:
                shadow = shadows[item].reshape(-1).at[where].get(mode="clip")
                shown = shown * shadow[:, None]
            return pixels.at[where].add(shown, mode="drop"), None

        pixels, _ = jax.lax.scan(block, pixels, tuple(of_each))
    return pixels.reshape(image.shape).astype(gbuffer.color.dtype)
