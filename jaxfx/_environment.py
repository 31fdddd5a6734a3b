"""An image of all directions: its spherical harmonics, and its blurs for rough mirrors.

Axes of an image: y up, row 0 at the top; the middle column looks along -z, the right half lies
at +x. So a texel's direction is (cos(b) sin(a), sin(b), -cos(b) cos(a)), a being its angle to
the right of the middle, b that above the horizon.

A blur is for one roughness: the mean of the radiance about a direction, weighted by GGX's lobe
as it is seen straight on. That of roughness 1 is the cosine: the blur holds what a matt surface
shows. Past 1 it passes over into the mean of a half sphere.

Directions of one row differ by a turn about y: so a blur is a product of matrices over rows and
a convolution along them, which is a product after a Fourier transform.

Source: Karis 2013, the split sum; Ramamoorthi & Hanrahan 2001, the nine coefficients. Blurring
by a Fourier transform along rows, and the blurs past 1, are our own.
"""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfx._harmonics import FACTORS
from jaxfx._numerics import absolute, safe_sqrt
from jaxfx._xla import apart


# The roughness of each level, and the most rows that it has, some two to a lobe's width. Level
# 0 is the image, the last a half sphere's mean. More rows take memory with their cube; fewer
# blur once more.
ROUGHNESSES = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 2.0)
_MOST_ROWS = (128, 64, 64, 32, 32, 32, 32, 32)
_COSINE = ROUGHNESSES.index(1.0)


def heights(height: int) -> tuple[int, ...]:
    """The rows of each level for an image of `height` rows."""
    return height, *(min(height, most) for most in _MOST_ROWS)


def blurs(image: Float[Array, "height width 3"]) -> Float[Array, "texel 3"]:
    """The texels of all levels, one level after another, row by row."""
    rows = heights(image.shape[0])
    smaller = {height: _shrunk(image, height) for height in set(rows)}
    levels = [image]
    for height, roughness in zip(rows[1:], ROUGHNESSES[1:], strict=True):
        weights = jnp.asarray(_lobes(height, roughness), image.dtype)
        waves = jnp.fft.rfft(smaller[height], axis=1)
        parts = [
            jnp.einsum("oif,ifc->ofc", weights, part, precision="highest")
            for part in (waves.real, waves.imag)
        ]
        levels.append(jnp.fft.irfft(jax.lax.complex(*parts), n=2 * height, axis=1))
    return jnp.concatenate([level.astype(image.dtype).reshape(-1, 3) for level in levels])


@functools.cache
def _lobes(height: int, roughness: float) -> Float[np.ndarray, "row row wave"]:
    """Weights of each row, after a Fourier transform along it, in the blur of each row."""
    sine, cosine = np.sin(_latitudes(height)), np.cos(_latitudes(height))
    turn = np.arange(2 * height) * np.pi / height
    between = sine[:, None, None] * sine[None, :, None]
    between = between + cosine[:, None, None] * cosine[None, :, None] * np.cos(turn)
    squared, alpha = (1 + np.clip(between, -1, 1)) / 2, roughness**2  # (N.H)**2
    if roughness > 1:
        lobe = (between > 0).astype(float)
    else:
        lobe = np.maximum(between, 0) / (squared * (alpha**2 - 1) + 1) ** 2
    lobe *= cosine[None, :, None]  # A texel's share of the sphere.
    lobe /= lobe.sum(axis=(1, 2), keepdims=True)
    return np.fft.rfft(lobe, axis=-1).real  # It is even.


def _latitudes(height: int) -> Float[np.ndarray, " height"]:
    """The angle of each row above the horizon."""
    return (0.5 - (np.arange(height) + 0.5) / height) * np.pi


def _shrunk(image: Float[Array, "height width 3"], height: int) -> Float[Array, "_ _ 3"]:
    """The image with fewer rows: means by area."""
    if height == image.shape[0]:
        return image
    down, across = _means(image.shape[0], height), _means(image.shape[1], 2 * height)
    down = down * np.cos(_latitudes(image.shape[0]))
    down /= down.sum(axis=1, keepdims=True)
    down, across = jnp.asarray(down, image.dtype), jnp.asarray(across, image.dtype)
    image = jnp.einsum("oi,iwc->owc", down, image, precision="highest")
    return jnp.einsum("oi,hic->hoc", across, image, precision="highest")


def _means(size: int, to: int) -> Float[np.ndarray, "to size"]:
    """Means over `to` equal parts of `size` texels."""
    edges = np.linspace(0, size, to + 1)
    low = np.maximum(edges[:-1, None], np.arange(size))
    high = np.minimum(edges[1:, None], np.arange(size) + 1)
    return np.maximum(high - low, 0) * (to / size)


def coefficients(image: Float[Array, "height width 3"]) -> Float[Array, "16 3"]:
    """The coefficients of `_harmonics`, in the image's axes."""
    height, width = image.shape[:2]
    # Means over texels, in which the radiance is even: by four nodes along each side.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    inside = (nodes + 1) / 2
    mean = lambda values: values @ (weights / 2)
    angle = ((np.arange(width)[:, None] + inside) / width - 0.5) * 2 * np.pi
    s, c = np.sin(angle), np.cos(angle)
    columns = [1 + 0 * s, s, c, s * s, s * c, c * c]
    columns += [s * s * s, s * s * c, s * c * c, c * c * c]
    columns = [mean(value) for value in columns]
    along = jnp.asarray(np.stack(columns), image.dtype)
    rows = jnp.einsum("kw,hwc->khc", along, image, precision="highest")
    above = (0.5 - (np.arange(height)[:, None] + inside) / height) * np.pi
    y, r = np.sin(above), np.cos(above)
    solid_angle = r * 2 * np.pi**2 / (height * width)
    # The polynomials of `_harmonics`, as (row's factor, index of `along`): y is constant along
    # a row, x is r * s, z is -r * c.
    polynomials = [
        [(1 + 0 * y, 0)],
        [(y, 0)],
        [(-r, 2)],
        [(r, 1)],
        [(r * y, 1)],
        [(-r * y, 2)],
        [(3 * r * r, 5), (-1 + 0 * y, 0)],
        [(-r * r, 4)],
        [(r * r, 3), (-y * y, 0)],
        [(3 * y * r**2, 3), (-(y**3), 0)],
        [(-y * r**2, 4)],
        [(5 * y * r**2, 5), (-y, 0)],
        [(-5 * r**3, 9), (3 * r, 2)],
        [(5 * r**3, 8), (-r, 1)],
        [(-(r**3), 7), (r * y * y, 2)],
        [(r**3, 6), (-3 * r * y * y, 1)],
    ]
    factors = np.zeros((16, len(columns), height))
    for k, terms in enumerate(polynomials):
        for factor, index in terms:
            factors[k, index] = mean(factor * solid_angle) * FACTORS[k]
    factors = jnp.asarray(factors, image.dtype)
    return jnp.einsum("mkh,khc->mc", factors, rows, precision="highest")


def look_up(
    pyramid: Float[Array, "texel 3"],
    rows: tuple[int, ...],
    direction: Float[Array, "height width 3"],
    roughness: Float[Array, "height width"],
) -> Float[Array, "height width 3"]:
    """The blur of that roughness in these directions, linear between texels and levels."""

    def places():
        angles = _angles(direction)
        steps = itertools.pairwise(ROUGHNESSES)
        level = sum(jnp.clip((roughness - low) / (high - low), 0, 1) for low, high in steps)
        first = jnp.clip(jnp.floor(level), 0, len(rows) - 2).astype(jnp.int32)
        share = level - first.astype(roughness.dtype)
        return share, _corners(rows, angles, first), _corners(rows, angles, first + 1)

    def read():
        share, near, far = apart(pyramid, places)
        t = share[..., None]
        return (1 - t) * _texels(pyramid, near) + t * _texels(pyramid, far)

    return apart(pyramid, read)


def irradiance(
    pyramid: Float[Array, "texel 3"],
    rows: tuple[int, ...],
    normal: Float[Array, "height width 3"],
) -> Float[Array, "height width 3"]:
    """The colour of a white Lambert surface: the blur by the cosine, linear between texels."""
    level = jnp.full(normal.shape[:2], _COSINE, jnp.int32)
    places = lambda: _corners(rows, _angles(normal), level)
    return apart(pyramid, lambda: _texels(pyramid, apart(pyramid, places)))


def _angles(direction: Float[Array, "height width 3"]) -> tuple[Array, Array]:
    """The angle to the right of the middle, and that above the horizon."""
    x, y, z = (direction[..., k] for k in range(3))
    across = x * x + z * z
    is_up = across == 0  # There an angle about the axis is no angle.
    right = _angle(jnp.where(is_up, 0, x), jnp.where(is_up, 1, -z))
    above = _angle(y, jnp.where(is_up, 1, safe_sqrt(across)))
    return right, jnp.where(is_up, jnp.sign(y) * (jnp.pi / 2), above)


# Of the angle whose tangent is t, over t, by powers of t**2: fitted for t in [0, 1] so that the
# angle is off by 4e-8 at most, less than float32 tells.
_ANGLE = (0.999999336, -0.333298607, 0.199465646, -0.139086247)
_ANGLE += (0.096421852, -0.055912166, 0.021862849, -0.004054538)


def _angle(y: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`arctan2(y, x)` of numbers that are not both 0: in float32 to 4e-8, its slope to 3e-5.

    XLA on a CPU calls the library's function number by number, which takes ten times as long.
    Types with more digits than the polynomial get it all the same.
    """
    if jnp.finfo(x.dtype).eps < 1e-8:
        return jnp.arctan2(y, x)
    height, width = absolute(y), absolute(x)
    is_steep = height > width
    ratio = jnp.where(is_steep, width, height) / jnp.where(is_steep, height, width)
    square, angle = ratio * ratio, jnp.zeros_like(ratio)
    for factor in reversed(_ANGLE):
        angle = angle * square + factor
    angle = angle * ratio
    angle = jnp.where(is_steep, jnp.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, jnp.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


class _Corners(NamedTuple):
    """The four texels about a place: their rows and columns as indices, and the place between.

    `upper` and `lower` are those of the rows' first texels in all levels, `left` and `right`
    columns; `across` and `down` are the shares of the right and the lower texels.
    """

    upper: Int[Array, "height width"]
    lower: Int[Array, "height width"]
    left: Int[Array, "height width"]
    right: Int[Array, "height width"]
    across: Float[Array, "height width"]
    down: Float[Array, "height width"]


def _corners(
    rows: tuple[int, ...],
    angles: tuple[Float[Array, "height width"], Float[Array, "height width"]],
    level: Int[Array, "height width"],
) -> _Corners:
    """The texels of a level about these angles."""
    right, above = angles
    starts = np.cumsum([0, *(2 * height * height for height in rows)])[:-1]
    height = jnp.asarray(rows, jnp.int32)[level]
    size, start = height.astype(right.dtype), jnp.asarray(starts, jnp.int32)[level]
    column = (right / (2 * jnp.pi) + 0.5) * 2 * size - 0.5
    row = jnp.clip((0.5 - above / jnp.pi) * size - 0.5, 0, size - 1)
    left, top = jnp.floor(column), jnp.floor(row)
    across, down = column - left, row - top
    left, top, width = left.astype(jnp.int32), top.astype(jnp.int32), 2 * height
    return _Corners(
        start + top * width,
        start + jnp.minimum(top + 1, height - 1) * width,
        # The picture closes to a ring: left of its first column lies its last.
        jnp.where(left < 0, left + width, left),
        jnp.where(left + 1 < width, left + 1, 0),
        across,
        down,
    )


def _texels(
    pyramid: Float[Array, "texel 3"], corners: _Corners
) -> Float[Array, "height width 3"]:
    """The blur between four texels."""
    upper, lower, left, right, s, t = corners
    s, t = s[..., None], t[..., None]
    at = lambda flat: pyramid.at[flat].get(mode="clip")
    above = (1 - s) * at(upper + left) + s * at(upper + right)
    return (1 - t) * above + t * ((1 - s) * at(lower + left) + s * at(lower + right))
