"""The residual of a lens: what a method of depth of field draws, less photographs."""

import dataclasses
import functools
import math
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxfx.dof._spoiled import spoiled
from jaxfx.dof._sprites import POINT_RADIUS, coverage, reach, row_half_width
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import scatter
from jaxfx.fit._descent import huber
from jaxfx.fit._pose import exposure_between, reduced, thinned
from jaxfx.lens import ThinLens


Effect = Literal["scatter", "layered"]
Tone = Literal["linear", "log"]
Values = dict[str, Array]

LENS = ("aperture", "focus_distance")
DISPARITY = ("scale", "shift")

# Start values of zero have no logarithm.
_SMALLEST = 1e-6

# Second difference of the defocus between neighbouring pixels, in pixels, at an edge in depth.
# It is 0 on a plane. With a larger one edges between near-by surfaces are missed, with a
# smaller one curved surfaces are taken for edges.
_STEP = 0.25

# Of the noise: the share of differences below one standard deviation, and the least deviation,
# as a share of the reference's.
_WITHIN, _LEAST_NOISE = 0.68, 1e-3

# A pixel whose difference is so many standard deviations has no say until they are estimated
# again: the loss of a lamp would hide what a step gains. Below some 5, pixels that tell the
# lens are left out.
_OUTLIER = 20.0

# By how much an unknown moves, a ratio, to see which pixels tell it.
_NUDGE = 0.03

# Strata of circles of confusion, of pixels with one noise.
BINS = 6

# Up to this circle of confusion, in pixels, a sprite's second moment is not its disc's.
_SMALL_COC = 8.0


class Pictures(NamedTuple):
    """The images of a fit, all of one size and type.

    - `references`: one for each lens.
    - `image`, `depth`, `behind`: as in the method.
    - `weights`: what the square of a pixel's difference counts.
    - `focal_pixels`: of each lens.
    """

    references: Float[Array, "picture height width channel"]
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    behind: tuple[Any, Any] | None
    weights: Float[Array, "height width"]
    focal_pixels: Float[Array, " picture"]

    def shrunk(self, factor: int) -> "Pictures":
        """The same at a size smaller by a whole factor."""
        small = functools.partial(reduced, factor=factor)
        behind = self.behind
        if behind is not None:
            behind = small(behind[0]), thinned(behind[1], factor)
        return Pictures(
            jax.vmap(small)(self.references),
            small(self.image),
            thinned(self.depth, factor),
            behind,
            small(self.weights[..., None])[..., 0],
            self.focal_pixels / factor,
        )


class Model(eqx.Module):
    """A method as a function of some of its parameters, the others as at the start.

    - `start`: all parameters; those of `LENS` have an entry for each picture.
    - `corrects`: 1 where the footprint is free, 0 where it is held at 0.
    - `names`: which of the parameters are searched.
    """

    pictures: Pictures
    start: Values
    corrects: Float[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)
    effect: Effect = eqx.field(static=True)
    max_coc: int | float = eqx.field(static=True)

    def values(self, unknowns: Values) -> Values:
        """All parameters from what is searched: logarithms, which are 0 at the start.

        The inverse softplus of gamma, and a shift as it is.
        """
        found = dict(self.start)
        for name, unknown in unknowns.items():
            start = self.start[name].astype(float)
            positive = jnp.maximum(start, _SMALLEST)
            if name == "gamma":
                base = positive + jnp.log(-jnp.expm1(-positive))
                value = jax.nn.softplus(base + unknown)
            elif name == "shift":
                value = start + unknown * self._middle().astype(float)
            elif name == "footprint":  # From -0.5 to 1.5.
                value = self.corrects * (0.5 + jnp.tanh(unknown - math.atanh(0.5)))
            else:
                value = positive * jnp.exp(unknown)
            found[name] = value.astype(self.start[name].dtype)
        return found

    def _middle(self) -> Array:
        """The median of the inverse depths: the unit of a shift."""
        depth = self.pictures.depth
        is_known = (depth > 0) & jnp.isfinite(depth)
        return jnp.nanmedian(jnp.where(is_known, 1 / jnp.where(is_known, depth, 1), jnp.nan))

    def depths(self, values: Values) -> tuple[Array, tuple[Any, Any] | None]:
        """The depth, and the second layer, with the scale and the shift of their inverse."""
        depth, behind = self.pictures.depth, self.pictures.behind
        if not set(DISPARITY).intersection(self.names):
            return depth, behind

        def moved(depth: Array) -> Array:
            is_known = depth > 0
            inverse = values["scale"] / jnp.where(is_known, depth, 1) + values["shift"]
            near = inverse > 0
            away = jnp.where(near, 1 / jnp.where(near, inverse, 1), jnp.inf)
            return jnp.where(is_known, away, depth)

        return moved(depth), None if behind is None else (behind[0], moved(behind[1]))

    def lens(self, values: Values, picture: int) -> ThinLens:
        """That of one picture."""
        aperture, focus = (values[name][picture] for name in LENS)
        return ThinLens(aperture, focus, self.pictures.focal_pixels[picture])

    def circles(self, values: Values) -> Float[Array, "picture height width"]:
        """The circles of confusion, in pixels, 0 where the depth is missing."""
        depth, _ = self.depths(values)
        number = self.pictures.focal_pixels.size
        lenses = (self.lens(values, picture) for picture in range(number))
        circles = jnp.stack([lens.circle_of_confusion(depth) for lens in lenses])
        return jnp.where(depth > 0, circles, 0)

    def __call__(self, values: Values) -> Float[Array, "picture height width channel"]:
        """The images of the method, with the footprint's correction where it is free."""
        depth, behind = self.depths(values)

        def draw(aperture, focus, focal):
            lens, image = ThinLens(aperture, focus, focal), self.pictures.image
            if self.effect == "scatter":
                gamma, epsilon, room = values["gamma"], values["epsilon"], self.max_coc
                drawn = scatter(image, depth, lens, gamma=gamma, epsilon=epsilon, max_coc=room)
            else:
                layers = {"behind": behind, "threshold": values["threshold"]}
                drawn = layered(image, depth, lens, max_coc=self.max_coc, **layers)
            if "footprint" not in self.names:
                return drawn
            coc = jnp.where(depth > 0, lens.circle_of_confusion(depth), 0)
            return drawn + values["footprint"] * _missing_blur(drawn, coc)

        focal = self.pictures.focal_pixels
        apertures, foci = (values[name] for name in LENS)
        if focal.size == 1:
            return draw(apertures[0], foci[0], focal[0])[None]
        return jax.vmap(draw)(apertures, foci, focal)


def _missing_blur(
    drawn: Float[Array, "height width channel"], coc: Float[Array, "height width"]
) -> Float[Array, "height width channel"]:
    """The correction of an image for the second moments of small sprites.

    A sprite covers whole pixels: up to a circle of a pixel it blurs nothing, a little above it
    blurs too much. Half the second derivative, times the moment that lacks, makes up for it.
    """
    blur = jnp.zeros_like(drawn)
    for axis, lacking in enumerate(_lacking_moments()):
        pad = [(1, 1) if a == axis else (0, 0) for a in range(3)]
        padded = jnp.pad(drawn, pad, mode="edge")
        before, after = (
            jax.lax.slice_in_dim(padded, at, at + drawn.shape[axis], axis=axis) for at in (0, 2)
        )
        grid = jnp.linspace(0, _SMALL_COC, lacking.size, dtype=coc.dtype)
        moment = jnp.interp(coc, grid, lacking.astype(coc.dtype), right=0)
        blur = blur + moment[..., None].astype(drawn.dtype) / 2 * (before - 2 * drawn + after)
    return blur


@functools.cache
def _lacking_moments() -> tuple[Any, Any]:
    """The second moments, down and across, of discs less their sprites', in square pixels.

    For diameters from 0 to `_SMALL_COC`. A disc's is a sixteenth of its diameter's square.
    """
    with jax.ensure_compile_time_eval():
        far = reach(_SMALL_COC)
        diameter = jnp.linspace(0, _SMALL_COC, 161, dtype=float)
        radius = jnp.maximum(diameter / 2, POINT_RADIUS)
        place = jnp.arange(-far, far + 1, dtype=float)
        widths = jax.vmap(lambda row: row_half_width(radius, row))(place)
        sprite = jax.vmap(lambda column: coverage(widths, column))(place)  # x, y, diameter
        sprite = sprite / jnp.sum(sprite, axis=(0, 1))[None, None]
        squares = place[:, None] ** 2
        across, down = (jnp.sum(jnp.sum(sprite, axis=a) * squares, axis=0) for a in (1, 0))
        return jax.device_get((diameter**2 / 16 - down, diameter**2 / 16 - across))


class Residual(eqx.Module):
    """The pictures drawn less the references, by Huber's loss, as a function of the unknowns.

    - `scale`: the standard deviation of the difference per pixel, in units of radiance; inf
      where a pixel has no say, 1 for plain squares.
    - `unit`: that of pixels far from edges.
    """

    model: Model
    scale: Float[Array, "picture height width"]
    unit: Float[Array, ""]
    is_robust: bool = eqx.field(static=True)
    exposure: bool = eqx.field(static=True)
    tone: Tone = eqx.field(static=True)

    def compare(self, unknowns: Values) -> tuple[Array, Array, Array, Array]:
        """The difference per pixel, what is drawn, gain and offset of each picture."""
        pictures = self.model.pictures
        drawn = self.model(self.model.values(unknowns))
        counts = pictures.weights[None] / (self.scale / self.unit) ** 2

        def exposed(shown, reference, counts, scale):
            return exposure_between(shown, reference, counts, scale[..., None], self.exposure)

        gain, offset = jax.vmap(exposed)(drawn, pictures.references, counts, self.scale)
        shown = gain * drawn + offset
        tone = functools.partial(_log_tone, white=jnp.mean(jnp.abs(pictures.references)))
        toned = tone if self.tone == "log" else lambda x: x
        difference = toned(shown) - toned(pictures.references)
        return difference, drawn, gain[:, 0, 0], offset[:, 0, 0]

    def weighted(self, difference: Array) -> Float[Array, "picture height width channel"]:
        """Residuals whose squares are the loss, in units of radiance far from edges."""
        root = jnp.sqrt(self.model.pictures.weights)[None, ..., None]
        if not self.is_robust:
            return (root * difference).astype(float)
        noise = (difference / self.scale[..., None]).astype(float)
        return self.unit.astype(float) * root.astype(float) * huber(noise)

    def __call__(self, unknowns: Values) -> Float[Array, "picture height width channel"]:
        return self.weighted(self.compare(unknowns)[0])


def _log_tone(x: Array, white: Array) -> Array:
    """A logarithm that is `x` itself near 0, and odd."""
    white = jnp.maximum(white, jnp.finfo(x.dtype).tiny)
    return white * jnp.sign(x) * jnp.log1p(jnp.abs(x) / white)


def plain(model: Model, exposure: bool, tone: Tone) -> Residual:
    """The residual of plain squares."""
    one = jnp.ones(model.pictures.references.shape[:3], model.pictures.image.dtype)
    return Residual(model, one, one[0, 0, 0], False, exposure, tone)


@eqx.filter_jit
def evaluate(residual: Residual, unknowns: Values) -> tuple[Array, Array, Array, Array]:
    """`residual.compare`, compiled: all that asks for no derivative shares this program."""
    return residual.compare(unknowns)


def size(residual: Residual, unknowns: Values) -> Float[Array, " picture"]:
    """The mean absolute difference of each picture.

    It needs no estimate of noise, and large differences do not decide alone.
    """
    difference = evaluate(residual, unknowns)[0]
    weights = residual.model.pictures.weights[None, ..., None]
    return jnp.mean(jnp.abs(difference) * weights, axis=(1, 2, 3))


def weighed(residual: Residual, unknowns: Values, apart: bool) -> Residual:
    """The residual with the noise that its pixels have at these unknowns.

    The noise is estimated where the pixels tell the lens, which the median of all would not
    look at. `apart`: pixels that the sprite of an edge in depth reaches have one of their own.
    They see hidden surfaces, which no method has: by it they count as much as they are right.
    """
    difference, drawn, *_ = evaluate(residual, unknowns)
    names = [name for name in unknowns if name in LENS + DISPARITY]
    told = jnp.zeros_like(drawn)
    for name in names or [name for name in unknowns if name != "footprint"]:
        nudged = unknowns | {name: unknowns[name] + _NUDGE}
        told = told + (evaluate(residual, nudged)[1] - drawn) ** 2
    values = residual.model.values(unknowns)
    scale, unit = _noise(residual.model, values, difference, told, apart)
    return dataclasses.replace(residual, scale=scale, unit=unit, is_robust=True)


@eqx.filter_jit
def _noise(model, values, difference, told, apart):
    """The standard deviation per pixel, and that of pixels far from edges."""
    told = told * model.pictures.weights[None, ..., None]
    least = _LEAST_NOISE * jnp.std(model.pictures.references) + jnp.finfo(told.dtype).tiny
    noise = functools.partial(_quantile, jnp.abs(difference), least=least)
    size = jnp.max(jnp.abs(difference), axis=-1)
    kept = lambda scale: jnp.where(size > _OUTLIER * scale, jnp.inf, scale)
    if not apart:
        everywhere = noise(told)
        return kept(jnp.full(size.shape, everywhere)), everywhere
    reached = functools.partial(_near_edges, max_coc=model.max_coc)
    edges = jax.vmap(reached)(_defocus(model, values), model.circles(values))
    near = edges[..., None]
    away, beside = noise(jnp.where(near, 0, told)), noise(jnp.where(near, told, 0))
    # Where nothing is told away from edges, these are all that there is.
    away = jnp.where(jnp.any(~near & (told > 0)), away, beside)
    return kept(jnp.where(edges, jnp.maximum(beside, away), away)), away


def _defocus(model: Model, values: Values) -> Float[Array, "picture height width"]:
    depth, _ = model.depths(values)
    number = model.pictures.focal_pixels.size
    each = [model.lens(values, picture).defocus(depth) for picture in range(number)]
    return jnp.where(depth > 0, jnp.stack(each), jnp.nan)


def _near_edges(defocus: Array, circles: Array, max_coc: int | float) -> Array:
    """The pixels that sprites beside an edge in depth, or of the frame, reach.

    A hole is no edge. Beyond the frame is what no image holds.
    """
    edge = jnp.ones(defocus.shape, bool).at[1:-1, 1:-1].set(False)
    # Of a plane, the defocus is linear in the pixel's place: a slope is no edge.
    for axis in (0, 1):
        bend = jnp.abs(jnp.diff(defocus, n=2, axis=axis)) > _STEP
        edge = edge | jnp.pad(bend, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
    return spoiled(edge, circles + 2, max_coc + 2)


def _quantile(size: Array, weight: Array, least: Array) -> Array:
    """The size below which `_WITHIN` of the weight lies."""
    order = jnp.argsort(size.reshape(-1))
    total = jnp.cumsum(weight.reshape(-1)[order])
    at = jnp.searchsorted(total, _WITHIN * total[-1])
    return jnp.maximum(size.reshape(-1)[order][jnp.minimum(at, size.size - 1)], least)


@functools.partial(jax.jit, static_argnames=("channels", "bins"))
def strata(
    circles: Float[Array, "picture height width"],
    scale: Float[Array, "picture height width"],
    channels: int,
    bins: int = BINS,
) -> Int[Array, " residual"]:
    """For each residual its stratum out of `2 * bins`: pixels with like circles and like noise.

    What a method gets wrong depends on these two. Strata of one noise have one size.
    """
    is_noisy = (scale > jnp.min(scale)).reshape(-1)
    circles = circles.reshape(-1)
    place = jnp.argsort(jnp.argsort(circles + jnp.where(is_noisy, 2 * jnp.max(circles), 0)))
    quiet = jnp.sum(~is_noisy)
    rank = jnp.where(is_noisy, place - quiet, place)
    size = jnp.maximum(jnp.where(is_noisy, is_noisy.size - quiet, quiet), 1)
    stratum = jnp.minimum(rank * bins // size, bins - 1) + jnp.where(is_noisy, bins, 0)
    return jnp.repeat(stratum, channels)


@eqx.filter_jit
def report(residual: Residual, unknowns: Values) -> tuple[Array, Array, Array, Array, Array]:
    """The Jacobian in the order of `ravel_pytree`, the residual, and the rest of `compare`."""
    flat, tree = ravel_pytree(unknowns)

    def both(flat):
        difference, *rest = residual.compare(tree(flat))
        weighted = residual.weighted(difference)
        return weighted, (weighted, *rest)

    columns, (weighted, *rest) = jax.jacfwd(both, has_aux=True)(flat)
    return columns.reshape(-1, flat.size), weighted, *rest
