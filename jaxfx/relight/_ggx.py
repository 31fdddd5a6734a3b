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

import jax.numpy as jnp
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
