"""The search of `fit.lights`: iteratively reweighted least squares.

Pixels are weighted by the biweight of their residuals, the lights are searched by least squares
under those weights, and so on. The scale of noise starts at the largest residual and is eased
down, by at most a half in each reweighting: at a wrong start, weights for the noise itself
would leave out the pixels that show it to be wrong.
"""

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete
from jaxfx._loops import varying_as, while_loop
from jaxfx.fit._descent import GAIN, PATIENCE, End, verdict
from jaxfx.fit._light_errors import LEAST_NOISE, brightness, linearized
from jaxfx.fit._light_model import (
    Model,
    Residual,
    Search,
    best_colors,
    color_shape,
    spread,
    with_values,
)
from jaxfx.fit._robust import CUT, biweight, lengths, noise_of
from jaxfx.light import Light


_logger = logging.getLogger("jaxfx")

# The most reweightings of a search; the largest factor by which the noise may fall in each; and
# the change of every weight, of 1, below which they end. A larger factor ends sooner, in wrong
# minima more often; a larger change stops before the weights are those of the noise.
_REWEIGHTINGS, _EASE, _SETTLED = 32, 2.0, 1e-2

# When a search between two reweightings has converged: see `descend`.
_LOOSE = {"patience": 2, "gain": 1e-2}


def search_in_rounds(
    rounds: int,
    lights: tuple[Light, ...],
    make: Callable[[Any], Model],
    visibilities: Any,
    search: Callable[[Model, tuple[Light, ...]], tuple[End, Array, Array]],
) -> tuple[Model, End, Array, Array]:
    """The model, end, weights and noise of the last round, with the losses of all.

    `make` takes the entries of `visibilities` to a model, `search` is one round.
    """
    entries_of = visibilities if callable(visibilities) else lambda lights, index: visibilities

    model = make(entries_of(lights, 0))
    end, weight, noise = search(model, lights)
    for index in range(1, rounds):
        model = make(entries_of(end.unknowns, index))
        again, weight, noise = search(model, end.unknowns)
        end = again._replace(losses=end.losses + again.losses)
    return model, end, weight, noise


def search_once(
    model: Model,
    lights: tuple[Light, ...],
    reference: Float[Array, "height width 3"],
    base_weight: Float[Array, "height width"],
    is_robust: bool,
    descend_on: Callable[..., End],
) -> tuple[End, Float[Array, "height width"], Float[Array, "2"]]:
    """One round: an `End` whose unknowns are lights; the weights and the noise at that end."""
    is_traced = not is_concrete(model, lights, reference, base_weight)
    if not is_traced:
        _warn_of_what_does_not_move(model, lights)
    search = Search(model, lights, spread(model.gbuffer, model.camera))
    unit = brightness(reference, base_weight)
    unknowns, weight, losses = search.unknowns(), base_weight, []
    noise = jnp.full(2, jnp.inf, reference.dtype)
    is_last = not is_robust
    end = End(unknowns, [], verdict(optx.RESULTS.successful))
    fitted = _lights(search, unknowns, reference, jnp.sqrt(base_weight)[..., None])
    if is_robust:  # A lamp in the image, far off from the start, counts little from the first.
        noise, weight = _reweighted(model, fitted, reference, base_weight, noise, unit)
    if is_traced:
        start = _Reweighted.of(unknowns, weight, noise)
        return _search_in_program(
            search, start, reference, base_weight, unit, is_robust, descend_on
        )
    for left in reversed(range(_REWEIGHTINGS)):
        root = jnp.sqrt(weight)[..., None]
        is_last = is_last or left == 0
        residual = Residual(search, reference, unit, root)
        if any(unknowns):
            end = descend_on(residual, unknowns, **({} if is_last else _LOOSE))
        else:
            end = end._replace(losses=[_mean_square(residual, unknowns)])
        unknowns = end.unknowns
        losses += end.losses
        fitted = _lights(search, unknowns, reference, root)
        if is_last or end.result != optx.RESULTS.successful:
            break
        noise, again = _reweighted(model, fitted, reference, base_weight, noise, unit)
        is_last = bool(jnp.max(jnp.abs(again - weight)) < _SETTLED * jnp.max(base_weight))
        weight = again
    square = unit.astype(float) ** 2
    end = End(tuple(fitted), [loss * square for loss in losses], end.result)
    return end, weight, noise


class _Reweighted(NamedTuple):
    """A search under a transform, after `count` reweightings."""

    count: Any
    unknowns: Any
    weight: Any
    noise: Any
    losses: Any
    result: Any
    is_last: Any
    has_ended: Any

    @classmethod
    def of(cls, unknowns: Any, weight: Array, noise: Array) -> "_Reweighted":
        """The start of a search."""
        no, zero = jnp.zeros((), bool), jnp.zeros((), int)
        result = verdict(jax.tree.map(jnp.asarray, optx.RESULTS.successful))
        return cls(zero, unknowns, weight, noise, None, result, no, no)


def _search_in_program(
    search: Search,
    start: _Reweighted,
    reference: Array,
    base_weight: Array,
    unit: Array,
    is_robust: bool,
    descend_on: Callable[..., End],
) -> tuple[End, Array, Array]:
    """The loop of `search_once` over traced data."""
    successful, most = optx.RESULTS.successful, _REWEIGHTINGS if is_robust else 1

    def once(at: _Reweighted) -> tuple[End, list[Any]]:
        root = jnp.sqrt(at.weight)[..., None]
        residual = Residual(search, reference, unit, root)
        if any(at.unknowns):
            loose, last = _LOOSE, {"patience": PATIENCE, "gain": GAIN}
            when = {name: jnp.where(at.is_last, last[name], loose[name]) for name in last}
            end = descend_on(residual, at.unknowns, **when)
        else:
            end = End(at.unknowns, [_mean_square(residual, at.unknowns)], at.result)
        return end, _lights(search, end.unknowns, reference, root)

    def step(at: _Reweighted) -> _Reweighted:
        end, fitted = once(at)
        ends = at.is_last | (end.result != successful)
        noise, weight = at.noise, at.weight
        is_last = at.is_last
        if is_robust:
            noise, weight = _reweighted(
                search.model, fitted, reference, base_weight, at.noise, unit
            )
            change = jnp.max(jnp.abs(weight - at.weight))
            is_last = (change < _SETTLED * jnp.max(base_weight)) | (at.count + 2 == most)
        flat = jnp.concatenate([jnp.reshape(loss, -1) for loss in end.losses])
        return _Reweighted(
            at.count + 1,
            end.unknowns,
            jnp.where(ends, at.weight, weight),
            jnp.where(ends, at.noise, noise),
            at.losses.at[at.count].set(flat),
            end.result,
            is_last,
            ends,
        )

    start = start._replace(is_last=jnp.asarray(not is_robust))
    start = varying_as((search, reference, base_weight), start)
    steps = jax.eval_shape(lambda at: once(at)[0].losses, start)
    length = sum(math.prod(loss.shape) for loss in steps)
    start = start._replace(losses=jnp.full((most, length), jnp.nan, float))
    at = while_loop(lambda at: ~at.has_ended & (at.count < most), step, start)
    root = jnp.sqrt(at.weight)[..., None]
    fitted = _lights(search, at.unknowns, reference, root)
    losses = [at.losses * unit.astype(float) ** 2]
    return End(tuple(fitted), losses, verdict(at.result)), at.weight, at.noise


@eqx.filter_jit
def _mean_square(residual, unknowns):
    return jnp.mean(residual(unknowns) ** 2)


@eqx.filter_jit
def _reweighted(model, lights, reference, base_weight, last, unit):
    """The noise, no less than half of the `last`, and the weights that follow from it."""
    length = lengths(model(lights) - reference, base_weight)
    is_reached = jnp.any(model.basis(lights) != 0, axis=(0, 3))
    estimated = noise_of(length, jnp.where(is_reached, base_weight, 0))
    least = jnp.minimum(last, jnp.max(length, axis=(1, 2)) / CUT) / _EASE
    noise = jnp.maximum(jnp.maximum(estimated, least), LEAST_NOISE * unit)
    return noise, base_weight * biweight(length, noise)


def _lights(search, unknowns, reference, root):
    """The lights of some unknowns, with their best colors where those are fitted."""
    lights = _moved(search, unknowns)
    if "color" not in search.model.names:
        return lights
    return _colored(lights, best_colors(_basis(search.model, lights), reference, root))


def _colored(lights: Sequence[Any], colors: Float[Any, "3 color"]) -> list[Any]:
    """The lights with these colors, 3 color, in their order."""
    rest, colored = jnp.asarray(colors.T, float), []
    for light in lights:
        count, _ = color_shape(light)
        own, rest = rest[:count].reshape(-1), rest[count:]
        field = "color" if count == 1 else "coefficients"
        select = lambda light, field=field: getattr(light, field)
        colored.append(eqx.tree_at(select, light, own.reshape(select(light).shape)))
    return colored


def _warn_of_what_does_not_move(model: Model, lights: tuple[Light, ...]) -> None:
    """Log the parameters that change nothing in the image; `ValueError` if none changes it."""
    values = [model.values(light) for light in lights]
    # Colors that are fitted are found whatever they were: a black one must not count as fixed.
    white = lambda light, own: with_values(
        light, {"color": jnp.ones_like(own["color"])} if "color" in own else {}
    )
    columns = linearized(model, tuple(map(white, lights, values)))[1]
    is_moving = np.asarray(jnp.any(columns != 0, axis=0)).tolist()
    moving, fixed = [], []
    for index, own in enumerate(values):
        for name, value in own.items():
            numbers, is_moving = is_moving[: len(value)], is_moving[len(value) :]
            (moving if any(numbers) else fixed).append(f"{name} of light {index}")
    names = ", ".join(fixed)
    if not moving:
        raise ValueError(
            "`lights(lights)` must start where something that is fitted changes the image, "
            f"got no derivative in {names}."
        )
    if fixed:
        _logger.warning("`lights` can't move %s, which changes nothing at the start.", names)


@eqx.filter_jit
def _moved(search, unknowns):
    return search.lights(unknowns)


@eqx.filter_jit
def _basis(model, lights):
    return model.basis(lights)
