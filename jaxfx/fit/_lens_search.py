"""The search of `fit.dof`: lenses compared and searched on small images, then refined."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfx._checks import is_concrete
from jaxfx._numerics import one_program
from jaxfx.dof.arguments import largest_coc
from jaxfx.fit._descent import End
from jaxfx.fit._in_program import each, stacked
from jaxfx.fit._lens_model import FULL_FOOTPRINT, LENS, Model, Values
from jaxfx.fit._lens_noise import weighed
from jaxfx.fit._lens_residual import Residual, evaluate, mean_size


# The lenses that are compared before any search, as factors of the start's, which may be off by
# as much. Steps are wide enough that neighbours look different and narrow enough that a search
# from the best reaches the lens.
_FACTORS = {
    "aperture": (0.5, 0.7, 1.0, 1.4, 2.0),
    "focus_distance": (0.7, 0.8, 0.9, 1.0, 1.12, 1.25, 1.43),
}
# From how many of their lowest local minima a search starts: the lowest before a search need
# not be the lowest after it. Each costs a search on small images.
_SEARCHES = 2

# Parameters of an effect whose loss may have a minimum on either side, and the factors on the
# best end from which they are searched again.
_SOFT, _RESTARTS = ("epsilon", "threshold"), (2.0, 0.5)

# The largest side of the images on which searches begin, in pixels, and what their largest
# circle of confusion must keep, in pixels: smaller circles show no lens.
_COARSE, _LEAST_COC = 112, 5.0

# Factors of the largest circle of confusion that is drawn: on the start's, for the lenses that
# are compared; on that of the last end, for a search. A search whose circles outgrow the bound
# goes on with a larger one, in as many rounds as the last number says. Larger factors cost
# time, smaller ones more rounds.
_TRIED_MARGIN, _MARGIN, _ROUNDS = 2.0, 1.25, 4

# The factor by which a search with a free footprint must differ less than one without, which
# has an unknown less. With 1, noise decides where an effect made the image itself.
_HANDICAP = 1.01

# When a search whose end is another's start has converged: see `descend`.
_SOON = {"patience": 2, "gain": 1e-3}
# When the last search has: each more step costs as much as all of a small image's.
_LAST = {"patience": 3}
# The radius of the first step on the images as given. The search begins near: with a radius
# of 1 a third of its evaluations went by before steps were long enough.
_NEAR = {"radius": 100.0}
# Evaluations to one with derivatives, on images with a side of more than `_COARSE` pixels:
# there derivatives are most of what a fit costs. With more a search ends farther from the
# minimum; on small images, which decide what minimum it is, each evaluation has them.
_EVERY = 4


class Search(NamedTuple):
    """How a lens is sought.

    - `residual`: from a model, of plain squares.
    - `solve`: `descend` with a solver.
    - `is_robust`: whether noise is estimated and small circles are corrected.
    - `max_coc`: the largest diameter that may be drawn, in pixels; None for any.
    - `ratios`: the parameters that have one factor for all images.
    """

    residual: Callable[[Model], Residual]
    solve: Callable[..., End]
    is_robust: bool
    max_coc: int | float | None
    ratios: tuple[str, ...]

    def run(self, model: Model) -> tuple[Residual, End, tuple[Values, ...]]:
        """The last residual, where it ended, and the parameters where small images ended.

        Small images, plain squares: compare lenses, search from the best. The same images,
        edges with a noise of their own: refine the best end, twice. Then the images as given.
        """
        shrink = _shrink(model, self.max_coc)
        images = model.images if shrink == 1 else model.images.shrunk(shrink)
        small = dataclasses.replace(model, images=images)
        small = self._with_bound(small, model.start, _TRIED_MARGIN, shrink)
        residual = self.residual(small)
        starts = self._best_starts(residual)
        origin = _origin(small, self.ratios)
        losses = [jnp.mean(residual.weighted(evaluate(residual, origin).difference) ** 2)]
        ends = self._refined(residual, starts)
        for name in (name for name in _SOFT if name in model.names):
            best = _ranked(residual, ends)[0].unknowns
            moved = [best | {name: best[name] + math.log(factor)} for factor in _RESTARTS]
            ends += self._refined(residual, moved)
        losses += [loss for end in ends for loss in end.losses]
        ends = _ranked(residual, ends)
        if self.is_robust:
            refined = self._beside_edges(residual, ends[0].unknowns)
            losses += [loss for end in refined for loss in end.losses]
            ends[0] = refined[0]
        full = small if shrink == 1 else model
        residual, end, more = self._finish(full, ends[0].unknowns)
        reported = tuple(
            small.values(end.unknowns) | {"loss": jnp.asarray(end.losses[-1])} for end in ends
        )
        return residual, end._replace(losses=losses + more), reported

    def _refined(self, residual: Residual, starts: list[Values]) -> list[End]:
        """The ends of searches from several starts."""
        return each(lambda start: self._refine(residual, start), starts, residual)

    def _refine(
        self, residual: Residual, unknowns: Values, has_edges: bool = False, **when: Any
    ) -> End:
        """A search whose end is another's start, at the noise of its own start."""
        if self.is_robust:
            residual = weighed(residual, unknowns, has_edges)
        return self._solve(residual, unknowns, **_SOON, **when)

    def _solve(self, residual: Residual, unknowns: Values, **when: Any) -> End:
        """`solve`, with derivatives at each evaluation or, on large images, at some."""
        is_large = max(residual.model.images.depth.shape) > _COARSE
        return self.solve(residual, unknowns, every=_EVERY if is_large else 1, **when)

    def _beside_edges(self, residual: Residual, unknowns: Values) -> list[End]:
        """Two searches in which edges have a noise of their own, the better one first.

        One has the sprites' own footprint, the other starts at that of a photograph. Far from
        edges small circles may be all there is: with the wrong footprint they are explained by
        a smaller aperture and a focus beyond all that is seen.
        """
        model = residual.model
        if "footprint" not in model.names:
            return [self._refine(residual, unknowns, has_edges=True)]
        with_footprint = lambda corrects: dataclasses.replace(
            residual, model=dataclasses.replace(model, corrects=corrects)
        )
        full = jnp.full_like(unknowns["footprint"], FULL_FOOTPRINT)
        none, one = jnp.zeros_like(model.corrects), jnp.ones_like(model.corrects)
        starts = [(none, unknowns), (one, unknowns | {"footprint": full})]
        search = lambda start: self._refine(with_footprint(start[0]), start[1], has_edges=True)
        ends = each(search, starts, residual)
        return _ranked(with_footprint(one), ends, (1.0, _HANDICAP))

    def _finish(self, model: Model, unknowns: Values) -> tuple[Residual, End, list[Array]]:
        """The last searches, on the images as given: residual, end, and the losses of all."""
        losses = []
        if self.is_robust:
            model = dataclasses.replace(model, corrects=jnp.ones_like(model.corrects))
        rounds = 0
        while True:
            rounds += 1
            model = self._with_bound(model, model.values(unknowns), _MARGIN)
            residual = self.residual(model)
            if self.is_robust:
                end = self._refine(residual, unknowns, has_edges=True, **_NEAR)
                unknowns, losses = end.unknowns, losses + end.losses
                residual = weighed(residual, unknowns, True)
            end = self._solve(residual, unknowns, **_LAST, **_NEAR)
            unknowns, losses = end.unknowns, losses + end.losses
            circles = model.circles(model.values(unknowns))
            is_bounded = self.max_coc is not None
            fits = is_bounded or not bool((circles > model.max_coc).any())
            if fits or rounds == _ROUNDS:
                return residual, end, losses

    def _with_bound(
        self, model: Model, values: Values, margin: float, shrink: int = 1
    ) -> Model:
        """The model with a `max_coc` of `margin` times the largest circle at these values.

        At least: it is rounded up to half an octave, so that searches from similar starts share
        their programs. A `max_coc` that the user gave is kept, over the factor of small images.
        """
        if self.max_coc is not None:
            return dataclasses.replace(model, max_coc=self.max_coc / shrink)
        depth, _ = model.depths(values)
        count = len(model.images.references)
        lenses = [model.lens(values, photograph) for photograph in range(count)]
        largest = max(largest_coc("dof", depth, lens) for lens in lenses)
        if margin * largest <= model.max_coc:
            return model
        octaves = math.ceil(2 * math.log2(margin * largest)) / 2
        return dataclasses.replace(model, max_coc=2.0**octaves)

    def _best_starts(self, residual: Residual) -> list[Values]:
        """The unknowns of the best lenses out of `_FACTORS`, one set for each search.

        Each photograph takes its own best lens, unless their ratios are known.
        """
        model = residual.model
        origin = _origin(model, self.ratios)
        names = [name for name in LENS if name in model.names]
        if not names:
            return [origin]
        factors = [_FACTORS[name] for name in names]
        points = np.log(list(itertools.product(*factors)))
        points = jnp.asarray(points, float)
        at_point = lambda point: {
            name: origin[name] + value for name, value in zip(names, point, strict=True)
        }
        size = lambda point: mean_size(residual, origin | at_point(point))
        sizes = jnp.stack(each(size, points, residual))  # point, photograph
        if self.ratios:
            sizes = jnp.broadcast_to(sizes.sum(axis=1, keepdims=True), sizes.shape)
        table = [len(factor) for factor in factors]
        ranks = jnp.stack([_lowest(column.reshape(table)) for column in sizes.T], axis=1)
        if is_concrete(ranks):
            # Where there are fewer minima, no search is made twice.
            ranks = jnp.asarray(list(dict.fromkeys(map(tuple, ranks.tolist()))))
        starts = []
        for rank in ranks:
            chosen = points[rank]  # photograph, name
            start = dict(origin)
            for name, values in zip(names, chosen.T, strict=True):
                start[name] = origin[name] + (values if origin[name].ndim else values[0])
            starts.append(start)
        return starts


def _origin(model: Model, ratios: tuple[str, ...]) -> Values:
    """The unknowns of the user's start, zeros: one per photograph where each has its own."""
    shape = lambda name: () if name in ratios else model.start[name].shape
    return {name: jnp.zeros(shape(name), float) for name in model.names}


@one_program
def _lowest(losses: Float[Array, "..."]) -> Int[Array, " search"]:
    """Flat indices of the `_SEARCHES` lowest local minima of a table, the lowest first.

    Where there are fewer, the last is repeated.
    """
    window = (3,) * losses.ndim
    one = (1,) * losses.ndim
    around = jax.lax.reduce_window(losses, jnp.inf, jax.lax.min, window, one, "SAME")
    least = jnp.where(losses <= around, losses, jnp.inf).reshape(-1)
    places = jnp.argsort(least, stable=True)[:_SEARCHES]
    count = jnp.maximum(jnp.sum(jnp.isfinite(least)), 1)
    return places[jnp.minimum(jnp.arange(_SEARCHES), count - 1)]


def _ranked(
    residual: Residual, ends: list[End], handicaps: tuple[float, ...] | None = None
) -> list[End]:
    """The ends, those first whose images differ least, by the mean absolute difference.

    That of each is multiplied by its handicap.
    """
    size = lambda unknowns: jnp.sum(mean_size(residual, unknowns))
    sizes = jnp.stack(each(size, [end.unknowns for end in ends], residual))
    if handicaps:
        sizes = sizes * jnp.asarray(handicaps, sizes.dtype)
    order = jnp.argsort(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf), stable=True)
    if is_concrete(order):
        return [ends[at] for at in order.tolist()]
    mapped = jax.tree.map(lambda leaf: leaf[order], stacked(ends))
    return [jax.tree.map(lambda leaf, at=at: leaf[at], mapped) for at in range(len(ends))]


def _shrink(model: Model, max_coc: int | float | None) -> int:
    """The whole factor by which the first images are smaller.

    It decides shapes, which can't depend on data under a transform. There `max_coc` is given:
    the largest circle of confusion at the start is then taken for half of it, under a transform
    or not, so that both find the same.
    """
    side = max(model.images.depth.shape)
    if max_coc is not None:
        largest = max_coc / _TRIED_MARGIN
    else:
        circles = model.circles(model.start)
        largest = float(jnp.max(jnp.where(jnp.isfinite(circles), circles, 0)))
    return max(1, min(math.ceil(side / _COARSE), int(largest / _LEAST_COC)))
