"""Normals from a renderer that returns images alone."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import check_image
from jaxfx._numerics import normalize
from jaxfx.light import DirectionalLight


def capture_normals(
    render: Callable[[Sequence[DirectionalLight]], Float[ArrayLike, "height width 3"]],
) -> Float[Array, "height width 3"]:
    """Normals, bump maps included, from two images under coloured lights.

    For a renderer that has no output of normals, to fill a `GBuffer` with.

    **Arguments:** `render`: a function of a sequence of three directional lights to the image,
    height width 3, linear RGB, of the scene with every surface white and Lambert, one-sided,
    and without shadows. The images' exposure does not matter: many renderers divide by pi.

    **Returns:** height width 3, unit vectors in world space, zero where both images are black.

    **Raises:** `ValueError` where `render` returns no image of three channels.

    **Gradient:** exact with respect to what `render` depends on; zero where an image is black.

    **Example:** a renderer that shows a wall which faces -z:

    >>> import jax.numpy as jnp
    >>> from jaxfx import relight
    >>> normal = jnp.array([0, 0, -1.0])
    >>> def render(lights):
    ...     color = sum(jnp.maximum(-l.direction @ normal, 0) * l.color for l in lights)
    ...     return jnp.broadcast_to(color, (8, 8, 3))
    >>> print(relight.capture_normals(render)[4, 4])
    [ 0.  0. -1.]

    A white Lambert surface under a red light on +x, a green one on +y and a blue one on +z
    shows max(N, 0); under three on the other side, max(-N, 0). The difference is N.

    Source: Kim, Lee & Kyung, equation 1.
    """
    axes = jnp.eye(3)
    front, back = (
        check_image(
            "capture_normals(render)",
            render([DirectionalLight(-side * axis, axis) for axis in axes]),
        )
        for side in (1, -1)
    )
    if front.shape[2] != 3 or front.shape != back.shape:
        raise ValueError(
            "`capture_normals(render)` must return images of one shape (height, width, 3), "
            f"got {front.shape} and {back.shape}."
        )
    return normalize(front - back)
