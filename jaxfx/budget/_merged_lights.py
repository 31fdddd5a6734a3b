"""A candidate for many lights: groups of near and dim lights as one light each."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfx._numerics import working_dtype
from jaxfx.budget._light_energy import Energy
from jaxfx.budget._search import Search
from jaxfx.light import EnvironmentLight, Light, SphericalHarmonicsLight
from jaxfx.relight.shading import render


_TINY = np.finfo(float).tiny

# The parameters that tell how near a light is to another of its kind, and their sizes.
_PLACE = {"position": 3, "direction": 3, "inner_angle": 1, "outer_angle": 1}

# The least part of all lights that merging must save to be tried, a ratio: for less it is not
# worth its trials.
_SAVED = 1 / 4


class Merged(eqx.Module):
    """Every group of lights as one: as bright as all, in their mean place by brightness."""

    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    shadowed: tuple[int, ...] = eqx.field(static=True)
    title: ClassVar[str] = "relighting by merged lights"

    def __call__(self, gbuffer: Any, camera: Any, lights: Any, visibilities: Any = None) -> Any:
        """The image, called like `relight.render`."""
        merged = [_merged([lights[index] for index in group]) for group in self.groups]
        first = [group[0] for group in self.groups]
        read = [visibilities[n] if n in self.shadowed else None for n in first]
        return render(gbuffer, camera, merged, visibilities=read)


def try_merging(search: Search, brought: Energy, lights: Sequence[Light]) -> None:
    """Try to merge lights into the fewest that keep to the error, by halving."""
    free, _ = brought.free_shadows(search.max_error)
    shadowed = tuple(index for index in brought.shadows if index not in free)
    depth = np.asarray(search.data[0].depth)
    reach = float(np.mean(depth, where=np.isfinite(depth))) if np.isfinite(depth).any() else 1
    places = {(index,): Place.of(light, reach) for index, light in enumerate(lights)}
    # The groups after no pair was joined, after one, after two, ...
    groups = [tuple(places)]
    # Light from all around has no place to be moved to.
    around = SphericalHarmonicsLight | EnvironmentLight
    alone = (i for i, light in enumerate(lights) if isinstance(light, around))
    apart = (*shadowed, *alone)
    while pair := nearest(places, apart):
        first, second = (places.pop(group) for group in pair)
        places[tuple(sorted(pair[0] + pair[1]))] = first.joined(second)
        groups.append(tuple(sorted(places)))
    low, high = int(_SAVED * len(lights)) + 1, len(groups)
    while low < high:
        middle = (low + high) // 2
        text = f"what {len(lights)} lights have beyond {len(groups[middle])} merged ones"
        trial = search.trial(Merged(groups[middle], shadowed), text)
        low, high = (middle + 1, high) if trial.error <= search.max_error else (low, middle)


class Place(NamedTuple):
    """Where a light is, and how bright.

    - `kind`: the name of its class, and whether it has a size.
    - `where`: position, direction and angles, in scene units.
    - `bright`: the sum of its color's channels.
    """

    kind: str
    where: Float[np.ndarray, "8"]
    bright: float

    @classmethod
    def of(cls, light: Light, reach: float) -> "Place":
        """The place of a light; an angle is as far as it moves a point at `reach`."""
        fields = [
            np.broadcast_to(np.asarray(getattr(light, name, 0), float), size)
            for name, size in _PLACE.items()
        ]
        position, direction, *angles = fields
        turns = [direction / max(np.linalg.norm(direction), _TINY), *angles]
        where = np.concatenate([position, *(reach * turn for turn in turns)])
        is_around = isinstance(light, SphericalHarmonicsLight)
        color = light.coefficients if is_around else light.color
        extent = "" if getattr(light, "light_size", None) is None else " with a size"
        return cls(type(light).__name__ + extent, where, float(jnp.abs(color).sum()))

    def joined(self, other: "Place") -> "Place":
        """Both as one, in their mean place by brightness."""
        total = self.bright + other.bright
        share = other.bright / total if total else 0.5
        return Place(self.kind, (1 - share) * self.where + share * other.where, total)


def nearest(groups: dict[tuple[int, ...], Place], apart: Sequence[int]) -> Any:
    """The two groups of one kind that lose least by joining; None if there are none.

    They lose the squared distances to their mean place, each times its brightness. Lights whose
    index is in `apart` stay alone.
    """
    keys = [group for group in groups if group[0] not in apart]
    kind = np.array([groups[key].kind for key in keys])
    where = np.array([groups[key].where for key in keys]).reshape(len(keys), -1)
    bright = np.array([groups[key].bright for key in keys])
    square_distance = np.square(where[:, None] - where[None]).sum(axis=-1)
    total = np.maximum(bright[:, None] + bright[None], _TINY)
    lost = square_distance * bright[:, None] * bright[None] / total
    lost[(kind[:, None] != kind[None]) | np.tri(len(keys), dtype=bool)] = np.inf
    if not np.isfinite(lost).any():
        return None
    first, second = np.unravel_index(np.argmin(lost), lost.shape)
    return keys[first], keys[second]


def _merged(lights: Sequence[Any]) -> Any:
    """One light for several of a kind: the sum of their colors, the mean of the rest."""
    if len(lights) == 1:
        return lights[0]
    dtype = working_dtype(*(leaf.dtype for leaf in jax.tree.leaves(lights)))
    together = jax.tree.map(lambda *x: jnp.stack([y.astype(dtype) for y in x]), *lights)
    bright = jnp.sum(together.color, axis=-1)
    total = jnp.sum(bright)
    share = jnp.where(total > 0, bright / jnp.where(total > 0, total, 1), 1 / len(lights))
    mean = jax.tree.map(lambda x: jnp.tensordot(share, x, 1), together)
    return eqx.tree_at(lambda light: light.color, mean, jnp.sum(together.color, axis=0))
