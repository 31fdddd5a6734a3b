"""The highlight of glTF's metallic-roughness material: GGX, Smith, Schlick.

With a = roughness**2 and H halfway between L and V, a light reflects

    (1 - F) * diffuse * N.L  +  F * lobe,
    lobe = N.L * a**2 / (1 + (N.H)**2 * (a**2 - 1))**2 * visibility,
    visibility = 1/2 / (N.L * root(N.V) + N.V * root(N.L)),
    root(c) = sqrt(a**2 + c**2 * (1 - a**2)),
    F = specular + (1 - specular) * w, w = (1 - V.H)**5.

glTF's distribution of normals is the fraction over pi. It is missing here because a light's
color is what a white Lambert surface shows of it, as everywhere in `relight`: the whole
material is multiplied by pi.

`1 - F` is `(1 - specular) * (1 - w)`: so the image is a sum of three terms, of which no light
knows a reflectance. Two are multiplied by reflectances, `diffuse * (1 - specular)` and
`specular`; the third, `lobe * w`, by none. `RelightState` keeps their sums.

Source: Walter et al. 2007, equation 33; Heitz 2014, equation 99; Schlick 1994, equation 15; put
together by glTF 2.0 (Khronos 2017, 2021), appendix B.3.
"""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import absolute


_Scalars = Float[Array, "height width"]
# Exponent of a Blinn surface of roughness 0.01, the least that tells: its highlight is a
# hundredth of a degree wide. That of 0 is infinitely bright; with a larger bound float32's
# second derivatives are.
_MOST_EXPONENT = 2 / 0.01**2 - 2
# The least denominator of the visibility, which is 0 where light and camera both lie in the
# surface's plane. It changes what lies within 1e-6 of that; with a smaller one float32's
# derivatives overflow there.
_LEAST_DENOMINATOR = 1e-10


def roughness_squared(exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """The a of the module's docstring, of a Blinn surface as rough: 1e-4 at least."""
    return 2 / (jnp.minimum(exponent, _MOST_EXPONENT) + 2)


def lobe_and_fresnel(
    is_lit: Bool[Array, "height width"],
    exponent: _Scalars,
    to_light: _Scalars,
    to_camera: _Scalars,
    beside_normal: _Scalars,
    beside_camera: _Scalars,
) -> tuple[_Scalars, _Scalars]:
    """The lobe and `w` of the module's docstring; both 0 where `is_lit` is false.

    - `exponent`: of a Blinn surface as rough, `2 / roughness**2 - 2`.
    - `to_light`, `to_camera`: N.L and N.V.
    - `beside_normal`, `beside_camera`: 1 - N.H and 1 - V.H, which keep the digits of both.
    """
    where_lit = lambda value, stand_in: jnp.where(is_lit, value, stand_in)
    alpha = roughness_squared(exponent)
    square = alpha * alpha
    light, camera = where_lit(to_light, 1), where_lit(absolute(to_camera), 1)
    beside = where_lit(beside_normal, 0)
    # (N.H)**2 a**2 + 1 - (N.H)**2, without cancellation.
    spread = square * (1 - beside) ** 2 + beside * (2 - beside)
    root = lambda cosine: jnp.sqrt(square + cosine * cosine * (1 - square))
    denominator = light * root(camera) + camera * root(light)
    visibility = 0.5 / jnp.maximum(denominator, _LEAST_DENOMINATOR)
    ratio = alpha / spread
    lobe = where_lit(light * visibility * (ratio * ratio), 0)
    beside = where_lit(beside_camera, 0)
    return lobe, beside * beside * beside * beside * beside


# Of `w`, averaged by the cosine over all directions to the light, as a polynomial in N.V that
# is fitted to a quadrature: it is off by 9e-6 at most.
_MEAN_GRAZING = (0.028164, -0.0798487, 0.0864393, -0.0436402, 0.0089679)


def mean_grazing(to_camera: _Scalars) -> _Scalars:
    """The mean of `w` under light that is the same from everywhere; `to_camera` is N.V."""
    cosine, mean = absolute(to_camera), jnp.zeros_like(to_camera)
    for factor in reversed(_MEAN_GRAZING):
        mean = mean * cosine + factor
    return mean


# Rows and columns of the table of `mean_lobe`: even steps of the root of the roughness, and of
# about that of N.V, since smooth surfaces change fast near grazing angles. Fewer are off by
# more than 0.001 at N.V = 0.02.
_ROUGHNESSES, _COSINES = 49, 65
# N.V at which its root begins to be a straight line, so that the slope at 0 is finite.
_LEAST_FACING = 0.002


class MeanLobe(NamedTuple):
    """The response of a highlight to light from everywhere, per pixel.

    - `specular`, `grazing`: of light that is the same from everywhere, the integrals over all
      directions of `lobe * (1 - w) / pi` and of `lobe * w / pi`.
    - `matt`: the share of it that is spread as a matt surface's, by N.L.
    - `mirrored`: the mean direction of the rest lies between the normal, 0, and the mirrored
      view, 1.
    - `roughness`: of the blur about that direction that is as wide as the rest; in [0, 2], as
      in `_environment`.
    """

    specular: _Scalars
    grazing: _Scalars
    matt: _Scalars
    mirrored: _Scalars
    roughness: _Scalars


def mean_lobe(to_camera: _Scalars, roughness: _Scalars) -> MeanLobe:
    """The lobe of a surface of that N.V and roughness, bilinear in a table.

    Karis looks into the mirrored direction, with the roughness of the surface. Here the lobe is
    two: one about the normal, which is what a matt surface gets, and a blur about a direction
    on the way to the mirrored one. Their sum has the lobe's own mean, direction and length:
    radiance that is linear in the direction is returned exactly, but at grazing angles by the
    roughest surfaces, whose lobe is wider than any blur. That is our own.

    Source: Karis 2013, the split sum.
    """
    table = jnp.asarray(_mean_lobes(), to_camera.dtype)
    row = jnp.sqrt(roughness) * (_ROUGHNESSES - 1)
    least = _LEAST_FACING**0.5
    column = (jnp.sqrt(absolute(to_camera) + _LEAST_FACING) - least) * (
        (_COSINES - 1) / ((1 + _LEAST_FACING) ** 0.5 - least)
    )
    top = jnp.clip(jnp.floor(row), 0, _ROUGHNESSES - 2)
    left = jnp.clip(jnp.floor(column), 0, _COSINES - 2)
    t, s = (row - top)[..., None], (column - left)[..., None]
    flat = top.astype(jnp.int32) * _COSINES + left.astype(jnp.int32)
    at = lambda offset: table.at[flat + offset].get(mode="clip")
    upper = (1 - s) * at(0) + s * at(1)
    mean = (1 - t) * upper + t * ((1 - s) * at(_COSINES) + s * at(_COSINES + 1))
    specular, grazing, mirrored, width = (mean[..., k] for k in range(4))
    return MeanLobe(specular, grazing, _matt(roughness), mirrored, width)


def _matt(roughness: Any) -> Any:
    """The share of a lobe that is spread by N.L.

    Of some polynomials, the best for metal balls of roughness 0.2 to 1 in two surroundings;
    with 0 the error at roughness 0.65 is three times as large.
    """
    cube = roughness * roughness * roughness
    return 1.2 * cube * (1 - cube * cube * roughness * roughness)


@functools.cache
def _mean_lobes(count: int = 64) -> Float[np.ndarray, "entry 4"]:
    """The table: a quadrature over halfway vectors that are spread as GGX's normals are."""
    x, weight = np.polynomial.legendre.leggauss(count)
    x, weight = (x + 1) / 2, weight / 2
    # Denser at both ends, where the integrand is steep.
    u, weight = (x * x * (3 - 2 * x))[:, None], (weight * 6 * x * (1 - x))[:, None] / count
    angle = np.pi * (np.arange(count) + 0.5) / count  # The other half circle is the same.
    table = np.empty((_ROUGHNESSES, _COSINES, 4))
    least, most = np.sqrt([_LEAST_FACING, 1 + _LEAST_FACING])
    facing = np.linspace(least, most, _COSINES) ** 2 - _LEAST_FACING
    facing = np.clip(facing, 1e-3, 1)[:, None, None]
    aside = np.sqrt(1 - facing**2)
    for row, roughness in enumerate(np.linspace(0, 1, _ROUGHNESSES) ** 2):
        square = max(roughness, 0.01) ** 4
        n_h = np.sqrt((1 - u) / (1 + (square - 1) * u))
        along = np.sqrt(1 - n_h**2) * np.cos(angle)
        v_h = facing * n_h + aside * along
        n_l, past = 2 * v_h * n_h - facing, aside - 2 * v_h * along
        is_lit = (n_l > 0) & (v_h > 0)
        light, v_h = np.where(is_lit, n_l, 1), np.where(is_lit, v_h, 0)
        root = lambda cosine, square=square: np.sqrt(square + cosine**2 * (1 - square))
        visibility = 0.5 / (light * root(facing) + facing * root(light))
        # The density of L is that of H, D * N.H, over 4 V.H.
        share = np.where(is_lit, 4 * light * visibility * v_h / n_h, 0) * weight
        w = (1 - v_h) ** 5
        sums = [share * (1 - w), share * w, share * past, share * n_l]
        specular, grazing, past, up = np.sum(sums, axis=(2, 3))
        # The mean of the rest, after the share about the normal, whose length is 2/3.
        matt, whole = _matt(roughness), specular + grazing
        past, up = past / whole / (1 - matt), (up / whole - matt * 2 / 3) / (1 - matt)
        length = np.hypot(past, up)
        slope, cosine, sine = past / up, facing[:, 0, 0], aside[:, 0, 0]
        bent = sine + slope * (1 - cosine)
        mirrored = np.where(bent > 1e-6, slope / np.where(bent > 1e-6, bent, 1), 1)
        table[row] = np.stack([specular, grazing, mirrored, _width(length)], axis=-1)
    return table.reshape(-1, 4)


def _width(length: Float[np.ndarray, " lobe"]) -> Float[np.ndarray, " lobe"]:
    """The roughness whose blur has a mean direction this long: past 1 those of the mixtures of
    the cosine, 2/3 long, and a half sphere, 1/2 long."""
    cosine = np.cos(np.linspace(0, 1, 2001) ** 2 * np.pi / 2)
    area = -np.gradient(cosine)
    roughness = np.linspace(0, 1, 101)
    square = np.maximum(roughness, 0.01)[:, None] ** 4
    lobe = area * cosine / ((1 + cosine) / 2 * (square - 1) + 1) ** 2
    lengths = (lobe * cosine).sum(axis=1) / lobe.sum(axis=1)
    lengths, roughness = np.append(lengths, 1 / 2), np.append(roughness, 2)
    return np.interp(-length, -lengths, roughness)
