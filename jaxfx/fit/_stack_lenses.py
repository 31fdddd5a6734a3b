"""The lenses of a focal stack, where they are not known: those under which planes fit best.

With a wrong lens no plane explains what the images show of a surface. So the energy under each
pixel's best plane is least for the true lenses, without a search for image or depth. Its
logarithm counts, so that pixels beside edges in depth, where no plane fits anyway, do not
decide.

A stack shows defocus alone: strength times inverse focus distance, less the same of the pixel.
One factor of all apertures can be told where the focus distances are known, or these, but for
a shift common to all and to the scene, where the apertures are.
"""

import math
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jaxfx._progress import Bar
from jaxfx.fit._descent import descend
from jaxfx.fit._jackknife import tiles
from jaxfx.fit._reduction import reduced
from jaxfx.fit._stack_planes import candidate_planes, least_energy


Unknown = Literal["aperture", "focus_distance"]

# Pixels of defocus from one plane to the next, of lenses larger than the start's by the ratio
# below. With half as many planes apertures of two walls are found 2 % too small, which are
# 0.3 % too small with these.
_STEP = 0.5
# Images are reduced as long as the largest circle of confusion stays above this many pixels.
_LEAST_CIRCLE = 12
# How much larger than the start's circles of confusion may be: for them images are mirrored
# beyond their border.
_LARGER = 1.5
# Change of a lens by an unknown of 1: of the logarithm of the aperture, or of inverse focus
# distances by steps between them. The first step is the slope, some 0.3 to 1 in these units.
_UNIT = 0.1
# Of the search, in unknowns and in the mean logarithm. A step is one evaluation.
_TOLERANCE, _MOST_STEPS = 1e-2, 64
# Standard error, in logarithms of the aperture or steps between foci, of what planes can't say:
# surfaces are slanted and hide each other. Apertures of the scenes of `docs/fits.md` are 0.2 to
# 1.8 % off, where their slopes alone state 0.1 to 0.3 %.
_LEAST_ERROR = 0.02
# Change of an unknown for differences of the slope, which give its derivative. The logarithm
# bends upwards about its least value alone: a smaller one has to begin nearer to that.
_DIFFERENCE = 0.5


class Lines(NamedTuple):
    """Each lens' pixels of defocus per unit of inverse depth, and inverse focus distance."""

    strengths: np.ndarray
    foci: np.ndarray


class Found(NamedTuple):
    """Lenses that were searched for, and the standard error of each one's unknown number.

    That is the logarithm of the aperture or the inverse focus distance. inf: nothing tells it.
    """

    lines: Lines
    errors: np.ndarray


class _Misfit(eqx.Module):
    """Per pixel, the root of the logarithm of the energy under its best plane.

    - `turn`: from unknowns to the change of each lens' number.
    """

    images: Float[Array, "photograph height width channel"]
    strengths: Float[Array, " photograph"]
    foci: Float[Array, " photograph"]
    candidates: Float[Array, " plane"]
    turn: Float[Array, "photograph unknown"]
    unknown: Unknown = eqx.field(static=True)
    pad: int = eqx.field(static=True)

    def lines(self, unknowns: Array) -> tuple[Array, Array]:
        """Strengths and foci of the lenses."""
        change = self.turn @ unknowns.astype(self.turn.dtype)
        if self.unknown == "aperture":
            return self.strengths * jnp.exp(change), self.foci
        return self.strengths, self.foci + change

    def energy(self, unknowns: Array) -> Float[Array, "height width"]:
        """The logarithm that is sought to be least, in the mean over pixels."""
        return least_energy(self.images, *self.lines(unknowns), self.candidates, self.pad)

    def __call__(self, unknowns: Array) -> Float[Array, " residual"]:
        # The small number keeps the derivative finite where nothing is left.
        return jnp.sqrt(self.energy(unknowns) + 1e-6).reshape(-1).astype(float)


def searched(
    images: Float[Array, "photograph height width channel"],
    start: Lines,
    bounds: tuple[float, float],
    unknown: Unknown,
    bar: Bar,
) -> Found:
    """The lenses under which planes between two inverse depths fit the images best."""
    ends = np.abs(start.strengths * (start.foci - np.array(bounds)[:, None]))
    factor = max(1, int(ends.max() / _LEAST_CIRCLE))
    strengths, largest = start.strengths / factor, ends.max() / factor
    images = jnp.stack([reduced(image, factor) for image in images])
    array = lambda values: jnp.asarray(values, images.dtype)
    misfit = _Misfit(
        images,
        array(strengths),
        array(start.foci),
        array(candidate_planes(bounds, _LARGER * strengths.mean(), _STEP)),
        array(_turn(start.foci, unknown)),
        unknown,
        math.ceil(_LARGER * largest / 2) + 2,
    )
    solver = optx.BFGS(rtol=_TOLERANCE, atol=_TOLERANCE)
    zeros = jnp.zeros(misfit.turn.shape[1], float)
    end = descend(misfit, zeros, solver=solver, max_steps=_MOST_STEPS, bar=bar)
    found = [np.asarray(each, float) for each in misfit.lines(end.unknowns)]
    lines = Lines(factor * found[0], found[1])
    covariance = _covariance(misfit, end.unknowns)
    if covariance is None:
        return Found(lines, np.full(len(lines.foci), np.inf))
    turn = np.asarray(misfit.turn, float)
    least = _LEAST_ERROR * np.linalg.norm(turn, axis=1).max() / _UNIT
    return Found(lines, np.sqrt(np.diag(turn @ covariance @ turn.T) + least**2))


def _turn(foci: np.ndarray, unknown: Unknown) -> np.ndarray:
    """The change of each lens' number by each unknown.

    Foci change by steps between them, orthogonally to a shift of all.
    """
    count = len(foci)
    if unknown == "aperture":
        return np.full((count, 1), _UNIT)
    step = np.ptp(foci) / (count - 1) or foci.mean() / 2
    apart = np.eye(count) - 1 / count
    return _UNIT * step * np.linalg.svd(apart)[0][:, :-1]


@eqx.filter_jit
def _slope(misfit: _Misfit, unknowns: Array) -> Float[Array, "unknown residual"]:
    """The derivative of each pixel's logarithm in each unknown."""
    directions = jnp.eye(unknowns.size, dtype=unknowns.dtype)
    along = lambda direction: jax.jvp(misfit.energy, (unknowns,), (direction,))[1]
    return jax.lax.map(along, directions).reshape(unknowns.size, -1).astype(float)


@eqx.filter_jit
def _total_slope(misfit: _Misfit, unknowns: Array) -> Float[Array, " unknown"]:
    return jax.grad(lambda at: jnp.sum(misfit.energy(at).astype(float)))(unknowns)


def _covariance(misfit: _Misfit, unknowns: Array) -> np.ndarray | None:
    """The sandwich estimate, with the slopes of tiles of the image taken for independent.

    None where the mean logarithm does not bend upwards: there is no least one.
    """
    block, count = tiles(misfit.images.shape[1:3])
    slope = _slope(misfit, unknowns)
    slopes = np.asarray(jax.ops.segment_sum(slope.T, block, count), float)
    rows = []
    for direction in np.eye(unknowns.size):
        move = jnp.asarray(_DIFFERENCE * direction, unknowns.dtype)
        after, before = (_total_slope(misfit, unknowns + sign * move) for sign in (1, -1))
        rows.append(np.asarray(after - before, float) / (2 * _DIFFERENCE))
    bend = np.array(rows)
    bend = (bend + bend.T) / 2
    if not np.isfinite(bend).all() or np.linalg.eigvalsh(bend)[0] <= 0:
        return None
    inverse = np.linalg.inv(bend)
    return inverse @ slopes.T @ slopes @ inverse
