"""The real spherical harmonics of degree 0 to 3, and what a matt surface makes of them.

They are, in the order of l, then m: 1; y, z, x; xy, yz, 3zz - 1, xz, xx - yy; y(3xx - yy), xyz,
y(5zz - 1), z(5zz - 3), x(5zz - 1), z(xx - yy), x(xx - 3yy), each times its factor.

Source: Ramamoorthi & Hanrahan 2001, equations 3 and 9; Sloan 2008, appendix A2.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


# Of each function the factor of its polynomial; they are orthonormal over the sphere.
_SQUARES = [1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]
_SQUARES += [35 / 8, 105, 21 / 8, 7 / 4, 21 / 8, 105 / 4, 35 / 8]
FACTORS = np.sqrt(np.array(_SQUARES) / (4 * np.pi))
# Of each function the share that is left of it in the light that falls onto a surface, when all
# directions above the surface have their say by the cosine. Of a light that is the same
# everywhere all is left: the unit is what a white Lambert surface shows of it.
LEFT = np.repeat([1, 2 / 3, 1 / 4, 0], [1, 3, 5, 7])
# Directions, all but evenly spread, that tell the functions apart.
_WAY_COUNT = 40


def polynomials(way: Any) -> list[Any]:
    """The sixteen polynomials of unit vectors, ... 3, without their factors."""
    x, y, z = (way[..., k] for k in range(3))
    xx, yy, zz = x * x, y * y, z * z
    second = [x * y, y * z, 3 * zz - 1, x * z, xx - yy]
    third = [y * (3 * xx - yy), x * y * z, y * (5 * zz - 1), z * (5 * zz - 3)]
    third += [x * (5 * zz - 1), z * (xx - yy), x * (xx - 3 * yy)]
    return [x * 0 + 1, y, z, x, *second, *third]


def irradiance(
    normal: Float[Array, "height width 3"], coefficients: Float[Array, "9 3"]
) -> Float[Array, "height width 3"]:
    """The colour of a white Lambert surface under the radiance that has these coefficients."""
    weights = coefficients * jnp.asarray((FACTORS * LEFT)[:9], normal.dtype)[:, None]
    # Written out: XLA does not fuse across a product of matrices.
    terms = [
        function[..., None] * weights[k][None, None]
        for k, function in enumerate(polynomials(normal)[:9])
    ]
    return functools.reduce(jnp.add, terms)


def turned(
    coefficients: Float[Array, "coefficient 3"], rotation: Float[Array, "3 3"]
) -> Float[Array, "coefficient 3"]:
    """The coefficients of a radiance whose own axes a rotation takes to the world's.

    The functions of a degree are turned into one another: so the radiance in some directions
    tells the new coefficients exactly.
    """
    count = len(coefficients)
    ways, inverse = (jnp.asarray(part, coefficients.dtype) for part in _ways(count))
    factors = jnp.asarray(FACTORS[:count], coefficients.dtype)[None]
    values = jnp.stack(polynomials(_product(ways, rotation))[:count], axis=-1) * factors
    return _product(inverse, _product(values, coefficients))


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


@functools.cache
def _ways(count: int) -> tuple[Float[np.ndarray, "way 3"], Float[np.ndarray, "count way"]]:
    """Directions, and the matrix from the radiance in them to `count` coefficients."""
    step = np.arange(_WAY_COUNT) + 0.5
    z, angle = 1 - 2 * step / _WAY_COUNT, step * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    ways = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)
    values = np.stack(polynomials(ways)[:count], axis=-1) * FACTORS[:count]
    return ways, np.linalg.pinv(values)
