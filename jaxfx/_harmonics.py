"""The nine real spherical harmonics of degree 0 to 2, and what a matt surface makes of them.

Source: Ramamoorthi & Hanrahan 2001, equations 3 and 9.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


# Of each function the factor of its polynomial; they are orthonormal over the sphere.
FACTORS = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * np.pi))
# Of each function the share that is left of it in the light that falls onto a surface, when all
# directions above the surface have their say by the cosine. Of a light that is the same
# everywhere all is left: the unit is what a white Lambert surface shows of it.
_LEFT = np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])


def irradiance(
    normal: Float[Array, "height width 3"], coefficients: Float[Array, "9 3"]
) -> Float[Array, "height width 3"]:
    """The colour of a white Lambert surface under the radiance that has these coefficients.

    The functions are, in the order of l, then m: 1; y, z, x; xy, yz, 3zz - 1, xz, xx - yy, each
    times its factor.
    """
    x, y, z = (normal[..., k] for k in range(3))
    one = jnp.ones_like(x)
    functions = [one, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    weights = coefficients * jnp.asarray(FACTORS * _LEFT, normal.dtype)[:, None]
    # Written out: XLA does not fuse across a product of matrices.
    terms = [
        function[..., None] * weights[k][None, None] for k, function in enumerate(functions)
    ]
    return functools.reduce(jnp.add, terms)
