"""Lights within an error."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfx._arguments import check_camera, check_gbuffer, check_lights
from jaxfx._checks import Number, as_array, shares
from jaxfx._numerics import working_dtype
from jaxfx.budget._plan import Part, Plan, Search, Trial, check_call
from jaxfx.budget._tiles import Blocks, blocks, spend, tile_of, tile_sums
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light
from jaxfx.relight.shading import Surface, check_shader, reflected, render, to_surface


# A light that is needed in more of the picture is computed in all of it: single pixels cost so
# many times as much.
_EVERYWHERE = 1 / 3
# The share of the error that shadows may take.
_SHADOWS = 1 / 4
_TINY = np.finfo(float).tiny
# What of a light tells how near it is to another of its kind, and of how many numbers it is.
_PLACE = {"position": 3, "direction": 3, "inner_angle": 1, "outer_angle": 1}
# As many must be saved by merging, of all, to try it.
_SAVED = 1 / 4
# Merged lights are tried in every fourth pixel of a row and of a column, if the picture has so
# many; in fewer, their time would be that of the calls.
_EVERY, _MANY = 4, 4096


class Everything(eqx.Module):
    """All lights and all shadows."""

    title: ClassVar[str] = "relighting"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """As the effect."""
        return render(gbuffer, camera, lights, visibilities=visibilities)


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
        name = "relight(visibilities)"
        seen = {n: as_array(name, visibilities[n]) for n in self.shadowed}
        chosen = lambda members: [(lights[n], seen.get(n)) for n in members]
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
        first = [group[0] for group in self.groups]
        visible = [visibilities[n] if n in self.shadowed else None for n in first]
        return render(gbuffer, camera, merged, visibilities=visible)


def relight(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    max_error: Number,
    visibilities: Sequence[Any] | None = None,
) -> Plan:
    """The fewest lights within an error of `relight.render` under all of them.

    Each light is shaded once, alone. What it brings to a tile of 8 x 8 pixels bounds what is
    missing there without it; lights are left out tile by tile, over the whole picture those
    first that bring least, for as long as the sum of the bounds is within the error. One that
    is needed in a few tiles is computed in these. A light whose shadow takes next to nothing
    away does without: its shadow map need not be made.

    Apart from that, lights are merged: of one kind those first that are dim and near (spot
    lights: that also shine alike), into the fewest that keep to the error in every fourth pixel
    of a row and of a column; found by halving. The quicker of the two ways is taken, if its
    error holds on the whole picture.

    It costs two renderings, one for the proof and one light by light, one by each of the two
    ways, and about half of one to merge.

    **Arguments:**

    - `gbuffer`, `camera`: as in `relight.render`, height width.
    - `lights`: a sequence of lights of any kinds.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `visibilities`: as in `relight.render`: for each light height width in [0, 1], or None if
      it has no shadows. None alone stands for no shadows at all.

    **Returns:** a `Plan`, to be called with `gbuffer, camera, lights` and, where there are
    shadows, `visibilities`: as many as there are here, None for those that are left out.

    **Raises:** `ValueError` as `relight.render`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice. The plan's picture has that of `relight.render` in
    the lights that are kept or merged; in the others it is zero.

    Source: tiles with their own lights are Olsson & Assarsson's 2011, tiled shading; one light
    for a near and dim group is Walter et al.'s 2005, lightcuts.
    """
    gbuffer = check_shader(check_gbuffer("relight(gbuffer)", gbuffer))
    check_camera("relight(camera)", camera)
    lights = check_lights("relight(lights)", lights)
    name, shape = "relight(visibilities=...)", gbuffer.depth.shape
    visible = tuple(shares(name, visibilities, len(lights), shape))
    data = (gbuffer, camera, lights)
    data = data if visibilities is None else (*data, visible)
    max_error = check_call("relight", max_error, data)
    parts = _parts(gbuffer, camera, *data[2:])
    search = Search(Everything(), data, max_error, parts)
    if lights:
        brought = _bring(gbuffer, camera, lights, visible)
        _try_merging(search, brought, lights)
        _try_tiles(search, brought)
    return search.plan()


def _parts(gbuffer: GBuffer, camera: Any, *lights: Any) -> list[Part]:
    """Some pixels of a scene, in rows and columns, as a camera of fewer pixels sees them."""
    if gbuffer.depth.size < _MANY:
        return []
    some = (slice(_EVERY // 2, None, _EVERY),) * 2
    # The pixel centres of the one camera at those of the other.
    shift = 0.5 - (_EVERY // 2 + 0.5) / _EVERY
    pose = camera.world_from_camera
    if isinstance(camera, OrthographicCamera):
        scale, centre = camera.pixels_per_unit / _EVERY, camera.center / _EVERY + shift
        camera = OrthographicCamera(scale, centre, pose)
    else:
        fewer = np.array([[1 / _EVERY, 0, shift], [0, 1 / _EVERY, shift], [0, 0, 1]])
        fewer = fewer.astype(camera.intrinsics.dtype)
        camera = PinholeCamera(fewer @ camera.intrinsics, pose)
    lights, *visibilities = lights
    visibilities = jax.tree.map(lambda x: jnp.asarray(x)[some], visibilities)
    return [Part((jax.tree.map(lambda x: x[some], gbuffer), camera, lights, *visibilities))]


class _Brought(NamedTuple):
    """What lights bring alone, as sums of squares over tiles, and what their shadows take.

    - `shadows`: by light, the root mean square that the shadow takes away, where there is one.
    """

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
    size, tiles = gbuffer.color.size, 1 + tile_of(gbuffer.depth.shape)[-1]
    energy, lit = np.zeros((2, tiles, len(lights)))
    shadows = {}
    for members in _kinds(lights, visibilities):
        some = [(lights[n], visibilities[n]) for n in members]
        squares = np.asarray(_squares(gbuffer, camera, some), float)
        lit[:, members], energy[:, members] = squares[0].T, squares[1].T
        if visibilities[members[0]] is not None:
            taken = np.sqrt(squares[2].sum(axis=1) / size)
            shadows |= dict(zip(members, taken.tolist(), strict=True))
    return _Brought(size, energy, lit, shadows)


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
    lights = search.data[2]
    pixels = blocks(parts[:, tile_of(search.data[0].depth.shape)], lights)
    reads = tuple(n for n in shadowed if share[n] > 0)
    way = Tiled(tuple(everywhere.tolist()), reads, pixels)
    # If its part of the work is no less than what merged lights take, it is not measured.
    work = float(np.minimum(share / _EVERYWHERE, 1).mean())
    merged = [trial.time for trial in search.tried if trial.error <= search.max_error]
    if work < min(merged, default=1):
        search.measure(way, "; ".join(texts))
    else:
        search.tried.append(Trial(way, "; ".join(texts), (), work))


def _named(kind: str, indices: Sequence[Any]) -> str:
    numbers = ", ".join(str(index) for index in indices)
    return f"{kind}{'s' if len(indices) > 1 else ''} {numbers}"


def _try_merging(search: Search, brought: _Brought, lights: Sequence[Light]) -> None:
    """Try to merge lights, into the fewest that will do: found by halving."""
    free, _ = brought.free(search.max_error)
    shadowed = tuple(index for index in brought.shadows if index not in free)
    depth = np.asarray(search.data[0].depth)
    reach = float(np.mean(depth, where=np.isfinite(depth))) if np.isfinite(depth).any() else 1
    places = {(index,): _Place.of(light, reach) for index, light in enumerate(lights)}
    # The groups that there are as one pair after another is joined.
    groups = [tuple(places)]
    while pair := _nearest(places, shadowed):
        one, other = (places.pop(group) for group in pair)
        places[tuple(sorted(pair[0] + pair[1]))] = one.joined(other)
        groups.append(tuple(sorted(places)))
    low, high = int(_SAVED * len(lights)) + 1, len(groups)
    while low < high:
        middle = (low + high) // 2
        text = f"what {len(lights)} lights have beyond {len(groups[middle])} merged ones"
        trial = search.trial(Merged(groups[middle], shadowed), text)
        low, high = (middle + 1, high) if trial.error <= search.max_error else (low, middle)


class _Place(NamedTuple):
    """Where a light is, and how bright."""

    kind: str
    where: Float[np.ndarray, "8"]
    bright: float

    @classmethod
    def of(cls, light: Light, reach: float) -> "_Place":
        """In scene units: an angle is how far it moves what lies at a distance of `reach`."""
        fields = [
            np.broadcast_to(np.asarray(getattr(light, name, 0), float), size)
            for name, size in _PLACE.items()
        ]
        position, direction, *angles = fields
        turns = [direction / max(np.linalg.norm(direction), _TINY), *angles]
        where = np.concatenate([position, *(reach * turn for turn in turns)])
        return cls(type(light).__name__, where, float(jnp.abs(light.color).sum()))

    def joined(self, other: "_Place") -> "_Place":
        """Both, in their mean place."""
        total = self.bright + other.bright
        share = other.bright / total if total else 0.5
        return _Place(self.kind, (1 - share) * self.where + share * other.where, total)


def _nearest(groups: dict[tuple[int, ...], _Place], apart: Sequence[int]) -> Any:
    """The two groups of one kind that lose least by joining; None if there are none."""
    keys = [group for group in groups if group[0] not in apart]
    kind = np.array([groups[key].kind for key in keys])
    where = np.array([groups[key].where for key in keys]).reshape(len(keys), -1)
    bright = np.array([groups[key].bright for key in keys])
    far = np.square(where[:, None] - where[None]).sum(axis=-1)
    total = np.maximum(bright[:, None] + bright[None], _TINY)
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


def _kinds(lights: Sequence[Light], shadows: Sequence[Any]) -> list[list[int]]:
    """The lights of each kind, those that have a shadow apart: each a program's loop."""
    kinds: dict[str, list[int]] = {}
    for index, (light, shadow) in enumerate(zip(lights, shadows, strict=True)):
        kinds.setdefault(f"{type(light)} {shadow is None}", []).append(index)
    return [kinds[kind] for kind in sorted(kinds)]


def _stacked(some: Sequence[Any], surface: Surface) -> tuple[Any, Any]:
    """Lights of a kind and, where one has a shadow, the shadows of all."""
    lights, shadows = zip(*some, strict=True)
    together = lambda *x: jnp.stack([y.astype(surface.position.dtype) for y in x])
    lights = jax.tree.map(together, *lights)
    if all(shadow is None for shadow in shadows):
        return lights, None
    lit = jnp.ones_like(surface.position[..., 0])
    shadows = together(*(lit if shadow is None else jnp.asarray(shadow) for shadow in shadows))
    return lights, jnp.where((surface.shader < 0)[None], 0, shadows)


@jax.jit
def _squares(gbuffer, camera, some):
    """Of each light the tiles' sums of squares: without its shadow, with it, what it takes."""
    surface = to_surface(gbuffer, camera)

    def each(both):
        light, shadow = both
        picture = reflected(surface, light)
        if shadow is None:
            return 2 * (tile_sums(picture**2),)
        shadow = shadow[..., None]
        parts = picture, picture * shadow, picture * (1 - shadow)
        return tuple(tile_sums(part**2) for part in parts)

    return jax.lax.map(each, _stacked(some, surface))


@jax.jit
def _tiled(gbuffer, camera, everywhere, parts):
    """The picture by lights and their shadows, and by those that are for some pixels."""
    surface = to_surface(gbuffer, camera)
    image = jnp.zeros_like(surface.position)
    again = jax.checkpoint(reflected, prevent_cse=False)

    def add(image, each):
        light, shadow = each
        part = again(surface, light)
        return image + (part if shadow is None else part * shadow[..., None]), None

    for members in _kinds(*zip(*everywhere, strict=True)) if everywhere else []:
        some = [everywhere[n] for n in members]
        image, _ = jax.lax.scan(add, image, _stacked(some, surface))

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), surface)
    pixels = image.reshape(-1, 3)
    for some, *of_each in parts:
        lights, shadows = _stacked(some, surface)

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
