"""The search for a lens: lenses tried on small pictures, searches there, then on all pixels."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfx.dof._inputs import largest_coc
from jaxfx.fit._descent import End
from jaxfx.fit._lens import LENS, Model, Residual, Values, evaluate, size, weighed


# The lenses that are tried before any search, as factors of the start's, and how many of the
# best of them are searched from.
_TRIED = {
    "aperture": (0.5, 0.7, 1.0, 1.4, 2.0),
    "focus_distance": (0.7, 0.8, 0.9, 1.0, 1.12, 1.25, 1.43),
}
_SEARCHES = 2
_SOFT, _RESTARTS = ("epsilon", "threshold"), (2.0, 0.5)

# The largest side of the pictures on which searches begin, in pixels, and what the largest
# circle of confusion must keep there: smaller ones tell no lens.
_COARSE, _LEAST_COC = 160, 5.0

# How much larger than the start's largest circle of confusion the lenses that are tried may
# draw, and how much larger than what was found a search may; how often a search that ran out of
# room goes on with more.
_TRIED_ROOM, _ROOM, _ROUNDS = 2.0, 1.25, 4

# A search whose end is but another's start has converged where a step gains less than this.
_SOON = {"patience": 2, "gain": 1e-3}


class Search(NamedTuple):
    """How a lens is sought.

    - `residual`: of plain squares, from a model.
    - `solve`: `descend` with a solver.
    - `is_robust`: whether noise is estimated and small circles are corrected.
    - `max_coc`: the largest diameter that may be drawn, in pixels; None for what is needed.
    - `ratios`: the parameters that have one factor for all pictures.
    """

    residual: Callable[[Model], Residual]
    solve: Callable[..., End]
    is_robust: bool
    max_coc: int | float | None
    ratios: tuple[str, ...]

    def run(self, model: Model) -> tuple[Residual, End, tuple[Values, ...]]:
        """The last residual, the end there, and the ends of the searches on small pictures."""
        shrink = _shrink(model)
        pictures = model.pictures if shrink == 1 else model.pictures.shrunk(shrink)
        small = dataclasses.replace(model, pictures=pictures)
        small = self._with_room(small, model.start, _TRIED_ROOM, shrink)
        residual = self.residual(small)
        tried = self._tried(residual)
        still = _still(small, self.ratios)
        losses, ends = [jnp.mean(residual.weighted(evaluate(residual, still)[0]) ** 2)], []
        for unknowns in tried:
            ends.append(self._refine(residual, unknowns))
        for name in (name for name in _SOFT if name in model.names):
            best = _best(residual, ends)[0].unknowns
            for factor in _RESTARTS:
                moved = best | {name: best[name] + math.log(factor)}
                ends.append(self._refine(residual, moved))
        losses += [loss for end in ends for loss in end.losses]
        ends = _best(residual, ends)
        if self.is_robust:
            ends[0] = self._refine(residual, ends[0].unknowns, apart=True)
            losses += ends[0].losses
        full = small if shrink == 1 else model
        residual, end, more = self._finish(full, ends[0].unknowns)
        told = tuple(
            small.values(end.unknowns) | {"loss": jnp.asarray(end.losses[-1])} for end in ends
        )
        return residual, end._replace(losses=losses + more), told

    def _refine(self, residual: Residual, unknowns: Values, apart: bool = False) -> End:
        """The end of a search that is but another's start."""
        if self.is_robust:
            residual = weighed(residual, unknowns, apart)
        return self.solve(residual, unknowns, **_SOON)

    def _finish(self, model: Model, unknowns: Values) -> tuple[Residual, End, list[Array]]:
        """The last searches, on the pictures as given, and all their losses."""
        losses = []
        if self.is_robust:
            model = dataclasses.replace(model, corrects=jnp.ones_like(model.corrects))
        rounds = 0
        while True:
            rounds += 1
            model = self._with_room(model, model.values(unknowns), _ROOM)
            residual = self.residual(model)
            if self.is_robust:
                end = self._refine(residual, unknowns, apart=True)
                unknowns, losses = end.unknowns, losses + end.losses
                residual = weighed(residual, unknowns, True)
            end = self.solve(residual, unknowns)
            unknowns, losses = end.unknowns, losses + end.losses
            circles = model.circles(model.values(unknowns))
            has_room = self.max_coc is not None or not bool((circles > model.max_coc).any())
            if has_room or rounds == _ROUNDS:
                return residual, end, losses

    def _with_room(self, model: Model, values: Values, room: float, shrink: int = 1) -> Model:
        """The model that draws circles so much larger than those of these values, at least."""
        if self.max_coc is not None:
            return dataclasses.replace(model, max_coc=self.max_coc / shrink)
        depth, _ = model.depths(values)
        number = len(model.pictures.references)
        lenses = [model.lens(values, picture) for picture in range(number)]
        largest = max(largest_coc("dof", depth, lens) for lens in lenses)
        if room * largest <= model.max_coc:
            return model
        # Two steps an octave: searches from near-by starts share their programs.
        octaves = math.ceil(2 * math.log2(room * largest)) / 2
        return dataclasses.replace(model, max_coc=2.0**octaves)

    def _tried(self, residual: Residual) -> list[Values]:
        """The unknowns of the best of the lenses that are tried, at least one."""
        model = residual.model
        still = _still(model, self.ratios)
        names = [name for name in LENS if name in model.names]
        if not names:
            return [still]
        factors = [_TRIED[name] for name in names]
        points = np.log(list(itertools.product(*factors)))
        points = jnp.asarray(points, float)
        moved = lambda point: {
            name: still[name] + value for name, value in zip(names, point, strict=True)
        }
        found = [size(residual, still | moved(point)) for point in points]
        found = np.asarray(jnp.stack(found), float)
        if self.ratios:
            found = np.broadcast_to(found.sum(axis=1, keepdims=True), found.shape)
        shape = [len(each) for each in factors]
        order = np.stack([_lowest(column.reshape(shape)) for column in found.T])
        tried = []
        for rank in order.T:
            at = points[rank]  # A point for each picture.
            shared = lambda name, values: values if still[name].ndim else values[0]
            columns = zip(names, at.T, strict=True)
            tried.append(
                still | {name: still[name] + shared(name, values) for name, values in columns}
            )
        return tried


def _still(model: Model, ratios: tuple[str, ...]) -> Values:
    """The unknowns at the start."""
    shape = lambda name: () if name in ratios else model.start[name].shape
    return {name: jnp.zeros(shape(name), float) for name in model.names}


def _lowest(losses: np.ndarray) -> np.ndarray:
    """The places of the lowest local minima of a table; the lowest again where they are few."""
    padded = np.pad(losses, 1, constant_values=np.inf)
    around = np.lib.stride_tricks.sliding_window_view(padded, (3,) * losses.ndim)
    least = losses <= around.min(axis=tuple(range(losses.ndim, 2 * losses.ndim)))
    places = np.flatnonzero(least)
    places = places[np.argsort(losses.reshape(-1)[places])][:_SEARCHES]
    return np.pad(places, (0, _SEARCHES - places.size), mode="edge")


def _best(residual: Residual, ends: list[End]) -> list[End]:
    """The ends, those first whose pictures differ least, by their mean absolute differences."""
    found = np.array([float(jnp.sum(size(residual, end.unknowns))) for end in ends])
    return [ends[at] for at in np.argsort(np.where(np.isfinite(found), found, np.inf))]


def _shrink(model: Model) -> int:
    """By how much smaller the first pictures are."""
    side = max(model.pictures.depth.shape)
    circles = model.circles(model.start)
    largest = float(jnp.max(jnp.where(jnp.isfinite(circles), circles, 0)))
    return max(1, min(math.ceil(side / _COARSE), int(largest / _LEAST_COC)))
