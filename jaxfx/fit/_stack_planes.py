"""Planes that are compared with a focal stack: of each, what the images say of every pixel.

Where the depth is constant, an image of the stack is the all-in-focus image convolved with a
disc. So for a candidate plane the image that explains the stack best is a quotient of Fourier
transforms, and what is left over, in a window about a pixel, tells how well the plane fits.
The spectra of images fall as 1 / frequency. So what is left over is led by low frequencies,
where the blur of nearer surfaces lies; times the frequency it is led by high ones, where noise
and aliasing lie. A plane is judged by both at once.

Where a plane is blurred, an image shows less of it, and more of what is near or behind. So an
image counts less the larger its circle of confusion is. One that is in focus beyond the plane
counts least: it shows what a thin surface there does not hide.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfx._loops import scan
from jaxfx._numerics import one_program


# Standard deviation in pixels of the window over which residuals are summed. A smaller one
# mistakes noise for depth, a larger one mixes surfaces.
WINDOW = 1.5
# Side in pixels of the blocks within which errors may depend on one another. With 1, rounding
# and aliasing, which neighbors share, would make standard errors too small.
_BLOCK = 5
# Noise that is always allowed for, as a ratio to the images' root mean square.
LEAST_NOISE = 1e-3
# Circle of confusion in pixels from which on an image counts less under a plane: where it is in
# focus beyond the plane, and where before it. With a smaller first one the surfaces behind lose
# what is beside a near one, with a larger one thin near surfaces are missed.
_BEYOND, _BEFORE = 8.0, 16.0
# Power of the noise over that of the image in the quotient, a ratio. Larger blurs the image,
# smaller lets the errors of one surface ring over others.
_NOISE = 1e-2
# A ratio. Residuals tell a depth where their steepness in it is larger than this times what
# noise alone has in the mean. With 1.5, noise tells a depth by chance in at most 2 % of the
# pixels that were tried; with 1, in up to 29 %.
_LEAST_STEEPNESS = 1.5


# Of the weighted median: its reach, and the standard deviation of its weights by nearness, both
# in pixels; that of the weights by color, as a ratio to the images' root mean square. A larger
# reach rounds surfaces off and swallows thin ones, a smaller one leaves the blur about edges.
# Chosen on rooms 500 to 503 of `tests/cases/rooms.py`.
_REACH, _NEAR, _ALIKE = 4, 2.0, 0.3
# Power of a pixel's energy by which the median trusts it less. With 1 more pixels beside edges
# keep a wrong depth, with 3 edges go where few strong pixels want them.
_TRUST = 2
# Least energy, as a ratio to the mean: what fits to rounding does not outweigh all.
_LEAST_ENERGY = 1e-6
# Numbers of candidate planes. A parabola is put through the energies of neighbors, which fewer
# planes do not allow; more take more memory, that of an image each.
_LEAST_PLANES, _MOST_PLANES = 8, 96


class Planes(NamedTuple):
    """Residual, slope and image per pixel under each candidate plane, planes first.

    - `energy`: geometric mean of two sums in the window, of squared residuals and of squared
      residuals times frequency, squared units of radiance. White noise has as much of both. It
      is divided by what unrelated images of unit power would leave, so that planes under which
      few images count can be compared with others.
    - `slope`: sum of squares of their derivatives in the inverse depth, less that of noise; 0
      where noise may have as much.
    - `spread`: variance of the sum of residuals times derivatives.
    - `image`: the all-in-focus image if all were on the plane.
    """

    energy: Float[Array, "plane height width"]
    slope: Float[Array, "plane height width"]
    spread: Float[Array, "plane height width"]
    image: Float[Array, "plane height width channel"]


def candidate_planes(
    bounds: tuple[float, float], strength: float, step: float
) -> Float[np.ndarray, " plane"]:
    """Evenly spaced inverse depths that are compared, from one bound to the other.

    `strength` is how many pixels the defocus changes by per unit of inverse depth. Neighbors
    differ by at most `step` pixels of defocus, or by more where that would take more than
    `_MOST_PLANES` planes.
    """
    count = math.ceil(strength * (bounds[1] - bounds[0]) / step) + 1
    return np.linspace(*bounds, min(max(count, _LEAST_PLANES), _MOST_PLANES))


class _Stack:
    """The spectra of a stack, and what is left of it under a candidate plane.

    `strengths` are the diameters of circles of confusion per unit of inverse depth, in pixels,
    `foci` the inverse depths in focus; `pad` is how many pixels the images are mirrored beyond
    their border.
    """

    def __init__(self, images: Array, strengths: Array, foci: Array, pad: int) -> None:
        self.strengths, self.foci, self.pad = strengths, foci, pad
        self.size, self.dtype = images.shape[1:3], images.dtype
        mirrored = jnp.pad(images, ((0, 0), (pad, pad), (pad, pad), (0, 0)), mode="symmetric")
        self.padded = rows, columns = mirrored.shape[1:3]
        self.spectra = jnp.fft.rfft2(mirrored, axes=(1, 2))
        frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None])
        self.frequency = jnp.asarray(frequency, self.dtype)

    def image_of(self, spectrum: Array) -> Array:
        """The pixels of a spectrum, without what is beyond the border."""
        whole = jnp.fft.irfft2(spectrum, s=self.padded, axes=(-3, -2))
        (height, width), pad = self.size, self.pad
        return whole[..., pad : pad + height, pad : pad + width, :].astype(self.dtype)

    def seen(self, inverse_depth: Array, weighed_at: Array) -> tuple[Array, Array]:
        """The root of each image's weight, and the transform of its disc times that root.

        The weights are those of a plane at `weighed_at`.
        """
        defocus = self.strengths * (self.foci - weighed_at)
        reach = jnp.where(defocus < 0, _BEYOND, _BEFORE).astype(self.dtype)
        weights = 1 / (1 + (defocus / reach) ** 2)
        roots = jnp.sqrt(weights / jnp.max(weights))[:, None, None]
        circles = jnp.abs(self.strengths * (self.foci - inverse_depth))
        return roots, roots * jax.vmap(lambda c: disc(c * self.frequency))(circles)

    def fitted(self, inverse_depth: Array, weighed_at: Array) -> tuple[Array, Array, Array]:
        """The residuals under a plane, those with high frequencies raised, and its image."""
        roots, blurs = (x[..., None] for x in self.seen(inverse_depth, weighed_at))
        quotients = blurs / (jnp.sum(blurs * blurs, axis=0) + _NOISE)[None]
        # The mean square frequency of an image is 1 / 6: white noise keeps its power.
        rise = (math.sqrt(6) * self.frequency)[..., None]
        roots, blurs, quotients, rise = (
            x.astype(self.spectra.dtype) for x in (roots, blurs, quotients, rise)
        )
        sharp = jnp.sum(quotients * roots * self.spectra, axis=0)
        left = roots * self.spectra - blurs * sharp[None]
        return self.image_of(left), self.image_of(rise[None] * left), self.image_of(sharp)

    def projector(self, inverse_depth: Array, weighed_at: Array) -> Array:
        """The matrix, at each frequency, from images to residuals under one plane."""
        roots, blurs = self.seen(inverse_depth, weighed_at)
        power = jnp.sum(blurs * blurs, axis=0) + _NOISE
        one = jnp.eye(len(self.foci), dtype=self.dtype)[..., None, None]
        return roots[:, None] * one - blurs[:, None] * (roots * blurs)[None] / power[None, None]

    def energy(self, plain: Array, risen: Array, projector: Array) -> Array:
        """The energy of a plane, see `Planes`, from the sums in the window of its residuals."""
        # What unrelated images would leave: in the plain sum and in that of high frequencies.
        unrelated = jnp.sum(projector * projector, axis=(0, 1))
        # Their power; times the square of the rise it is even.
        frequency = self.frequency
        pink = jnp.where(frequency > 0, 1 / jnp.where(frequency > 0, frequency, 1) ** 2, 0)
        share = jnp.mean(unrelated) * jnp.sum(pink * unrelated) / jnp.sum(pink)
        return jnp.sqrt(plain) * jnp.sqrt(risen) / jnp.sqrt(share)


@functools.partial(jax.jit, static_argnames=("pad",))
def compared(
    images: Float[Array, "photograph height width channel"],
    strengths: Float[Array, " photograph"],
    foci: Float[Array, " photograph"],
    candidates: Float[Array, " plane"],
    pad: int,
) -> Planes:
    """The planes at inverse depths `candidates`; for the other arguments see `_Stack`."""
    stack = _Stack(images, strengths, foci, pad)
    floor = LEAST_NOISE**2 * jnp.mean(images * images)

    def plane(carry: None, inverse_depth: Array) -> tuple[None, Planes]:
        along = (inverse_depth,), (jnp.ones_like(inverse_depth),)
        fitted = lambda at: stack.fitted(at, inverse_depth)
        (residual, fine, sharp), (slope, *_) = jax.jvp(fitted, *along)
        over = (0, 3)
        # Noise alone has slopes too: as much, for the residuals that it leaves, as white noise.
        left, turned = jax.jvp(lambda at: stack.projector(at, inverse_depth), *along)
        white = jnp.sum(turned * turned) / jnp.sum(left * left)
        plain, risen = (windowed(jnp.sum(x * x, axis=over)) for x in (residual, fine))
        steepness = jnp.sum(slope * slope, axis=over)
        score = _boxed(jnp.sum(residual * slope, axis=over)) / _BLOCK
        spread = windowed(score * score + floor * steepness)
        steep, noise = windowed(steepness), white * plain
        told = jnp.where(steep > _LEAST_STEEPNESS * noise, steep - noise, 0)
        return carry, Planes(stack.energy(plain, risen, left), told, spread, sharp)

    return scan(plane, None, candidates)[1]


def least_energy(
    images: Float[Array, "photograph height width channel"],
    strengths: Float[Array, " photograph"],
    foci: Float[Array, " photograph"],
    candidates: Float[Array, " plane"],
    pad: int,
) -> Float[Array, "height width"]:
    """The logarithm of each pixel's energy under the best plane over noise, from 0.

    Between planes the energy is a parabola, as in `best`. No plane is kept, for a derivative
    neither: that of `strengths` and `foci` computes them again.
    """
    stack = _Stack(images, strengths, foci, pad)
    area = 2 * math.pi * WINDOW**2 * images.shape[-1]
    noise = LEAST_NOISE**2 * area * jnp.mean(images * images)

    @jax.checkpoint
    def energy(at: Array) -> Array:
        residual, fine, _ = stack.fitted(at, at)
        plain, risen = (windowed(jnp.sum(x * x, axis=(0, 3))) for x in (residual, fine))
        return stack.energy(plain, risen, stack.projector(at, at))

    def plane(carry: tuple[Array, Array, Array], at: Array) -> tuple[Any, None]:
        least, before, middle = carry
        after = energy(at)
        bend = before - 2 * middle + after
        is_vertex = (middle <= before) & (middle <= after) & (bend > 0)
        # Ones in place of what is not taken keep its derivative finite.
        fall = jnp.where(is_vertex, before - after, 1) ** 2
        # A parabola through energies near 0 may pass below it.
        vertex = jnp.maximum(middle - fall / (8 * jnp.where(is_vertex, bend, 1)), 0)
        return (jnp.where(is_vertex, jnp.minimum(least, vertex), least), middle, after), None

    first, second = energy(candidates[0]), energy(candidates[1])
    (least, _, last), _ = scan(plane, (first, first, second), candidates[2:])
    return jnp.log1p(jnp.minimum(least, last) / jnp.maximum(noise, jnp.finfo(noise.dtype).tiny))


def disc(cycles: Float[Array, "..."]) -> Float[Array, "..."]:
    """The Fourier transform of a disc of area 1, at its diameter times the frequency.

    It is `2 J1(x) / x` with `x = pi * cycles`, as the integral of `sqrt(1 - t^2) cos(x t)` by
    Gauss and Chebyshev's rule, exact to rounding for circles of 60 pixels.
    """
    count = 144
    angles = np.pi * np.arange(1, count + 1) / (count + 1)
    weights = 2 * np.sin(angles) ** 2 / (count + 1)

    def add(total: Array, node: tuple[Array, Array]) -> tuple[Array, None]:
        place, weight = node
        return total + weight * jnp.cos(np.pi * place * cycles), None

    # The rule is symmetric: half of the nodes, each twice.
    half = count // 2
    nodes = [
        jnp.asarray(values[:half], cycles.dtype) for values in (np.cos(angles), 2 * weights)
    ]
    return scan(add, jnp.zeros_like(cycles), tuple(nodes))[0]


def windowed(values: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """The sum over the window about each pixel, of weight 1 at the pixel."""
    far = int(np.ceil(3 * WINDOW))
    weights = np.exp(-0.5 * (np.arange(-far, far + 1) / WINDOW) ** 2)
    return _summed(values, weights)


def _boxed(values: Float[Array, "height width"]) -> Float[Array, "height width"]:
    return _summed(values, np.ones(_BLOCK))


def _summed(values: Array, weights: np.ndarray) -> Array:
    """The weighted sums over rows and columns; beyond the border the last pixel is repeated."""
    far = len(weights) // 2
    for axis in (0, 1):
        pads = [(far, far) if a == axis else (0, 0) for a in (0, 1)]
        padded = jnp.pad(values, pads, mode="edge")
        size, total = values.shape[axis], jnp.zeros_like(values)
        for at, weight in enumerate(weights):
            part = jax.lax.slice_in_dim(padded, at, at + size, axis=axis)
            total = total + jnp.asarray(weight, values.dtype) * part
        values = total
    return values


@one_program
def best(planes: Planes, candidates: Array) -> Float[Array, "height width"]:
    """The inverse depth of least energy, by a parabola through the best plane's neighbors."""
    energy = planes.energy
    index = jnp.clip(jnp.argmin(energy, axis=0), 1, len(candidates) - 2)
    before, at, after = (at_index(energy, index + step) for step in (-1, 0, 1))
    bend = before - 2 * at + after
    step = jnp.where(bend > 0, (before - after) / jnp.where(bend > 0, 2 * bend, 1), 0)
    spacing = candidates[1] - candidates[0]
    return candidates[0] + spacing * (index.astype(step.dtype) + jnp.clip(step, -1, 1))


@jax.jit
def settled(
    inverse_depth: Float[Array, "height width"],
    energy: Float[Array, "height width"],
    guide: Float[Array, "height width channel"],
) -> Float[Array, "height width"]:
    """The median about each pixel, weighted by trust, by nearness, and by likeness of color.

    Beside an edge in depth no plane explains the images: the energy is large, and the trust,
    its power of -2, small. Pixels take there the depth of others of their color. `guide` has a
    root mean square of 1.
    """
    mean = jnp.mean(energy)
    least = _LEAST_ENERGY * mean + jnp.finfo(energy.dtype).tiny
    trust = (mean / jnp.maximum(energy, least)) ** _TRUST
    height, width = inverse_depth.shape
    far = _REACH
    near = np.exp(-0.5 * (np.arange(-far, far + 1) / _NEAR) ** 2)
    padded = lambda x: jnp.pad(x, [(far, far)] * 2 + [(0, 0)] * (x.ndim - 2))
    sources = padded(inverse_depth), padded(trust), padded(guide)

    def neighbors(row: Array) -> tuple[Array, Array]:
        """The values and weights of one row, taps first."""
        rows = [jax.lax.dynamic_slice_in_dim(x, row, 2 * far + 1) for x in sources]
        values, trusts, colors = (
            jnp.stack([x[:, at : at + width] for at in range(2 * far + 1)], axis=1)
            for x in rows
        )
        off = jnp.sum((colors - colors[far, far][None, None]) ** 2, axis=-1)
        weights = trusts * jnp.exp(-off / (2 * _ALIKE**2))
        weights = weights * jnp.asarray(near[:, None, None] * near[:, None], weights.dtype)
        return values.reshape(-1, width), weights.reshape(-1, width)

    def row(carry: None, at: Array) -> tuple[None, Array]:
        values, weights = neighbors(at)
        order = jnp.argsort(values, axis=0)
        values, weights = (jnp.take_along_axis(x, order, axis=0) for x in (values, weights))
        sums = jnp.cumsum(weights, axis=0)
        index = jnp.argmax(sums >= sums[-1:] / 2, axis=0)
        median = jnp.take_along_axis(values, index[None], axis=0)[0]
        return carry, jnp.where(sums[-1] > 0, median, inverse_depth[at])

    return scan(row, None, jnp.arange(height))[1]


@one_program
def explained(
    images: Float[Array, "photograph height width channel"],
    drawn: Float[Array, "photograph height width channel"],
) -> Float[Array, ""]:
    """The median share of what varies between images that those that are drawn explain.

    Over windows that vary twice as much as noise would, and without the noise. It is that of
    the image that has least, from its mixed second differences (Immerkaer 1996); the median of
    their sizes is that of noise, with few edges. -inf where nothing varies.
    """
    mixed = jnp.diff(jnp.diff(images, n=2, axis=1), n=2, axis=2) / 6
    deviation = jnp.median(jnp.abs(mixed), axis=(1, 2, 3)) / 0.6745
    noise = jnp.min(deviation**2)
    noise = jnp.where(jnp.isfinite(noise), noise, 0)
    window = 2 * math.pi * WINDOW**2
    mean = jnp.mean(images, axis=0, keepdims=True)
    left, varies = (
        windowed(jnp.mean(x * x, axis=(0, 3))) / window for x in (drawn - images, images - mean)
    )
    is_seen = varies > 2 * noise + LEAST_NOISE**2 * jnp.mean(images * images)
    share = jnp.maximum(left - noise, 0) / jnp.where(is_seen, varies - noise, 1)
    ratio = jnp.nanmedian(jnp.where(is_seen, share, jnp.nan))
    return jnp.where(jnp.any(is_seen), 1 - ratio, -jnp.inf)


@one_program
def around(mask: Bool[Array, "height width"]) -> Bool[Array, "height width"]:
    """Whether the mask holds anywhere within the reach of `settled`."""
    return _summed(mask.astype(jnp.float32), np.ones(2 * _REACH + 1)) > 0


def at_index(values: Array, index: Array) -> Array:
    """The entry of each pixel along the first axis."""
    index = index.reshape(1, *index.shape, *(1,) * (values.ndim - 3))
    return jnp.take_along_axis(values, index, axis=0)[0]


@one_program
def at_inverse_depth(values: Array, candidates: Array, inverse_depth: Array) -> Array:
    """The values of the planes, interpolated linearly at each pixel's inverse depth."""
    place = (inverse_depth - candidates[0]) / (candidates[1] - candidates[0])
    index = jnp.clip(jnp.floor(place).astype(int), 0, len(candidates) - 2)
    share = jnp.clip(place - index.astype(place.dtype), 0, 1)
    share = share.reshape(*share.shape, *(1,) * (values.ndim - 3))
    return (1 - share) * at_index(values, index) + share * at_index(values, index + 1)
