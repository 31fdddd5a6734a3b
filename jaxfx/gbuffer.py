"""The deep frame buffer: the shading parameters of every pixel."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._checks import as_array, parameter, share


__all__ = ["GBuffer"]


@final
class GBuffer(eqx.Module):
    """A cache of the eight shading parameters per pixel that do not depend on lights.

    Render a scene into it once, then shade it under any lights with `jaxfx.relight`. Positions
    follow from `depth` and the camera.

    **Arguments:** images of one height and width.

    - `color`: height width 3, base colour of the surface, linear RGB.
    - `shader`: height width, integers: -1 nothing, 0 Lambert, 1 Phong, 2 Blinn.
    - `ambient`, `diffuse`, `specular`: height width 3, the linear RGB reflectances that
      ambient, diffuse and specular light are multiplied by (they include the base colour).
    - `normal`: height width 3, unit vectors in world space, zero where there is nothing.
    - `depth`: height width, scene units along the optical axis, inf where there is nothing.
    - `roughness`: height width, in [0, 1].

    **Raises:** `ValueError` where a shape does not fit `color`, `shader` is not of integers, or
    a roughness lies outside [0, 1]. Traced values are not checked: one above 1 counts as 1.

    **Gradient:** exact with respect to every float image; `shader` has none.

    **Example:** a white Lambert wall at depth 3:

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white, white, normal, depth, jnp.ones((8, 8)))
    >>> wall.normal.shape, wall.depth.shape
    ((8, 8, 3), (8, 8))

    Source: Pellacini et al. 2005 (Lpics); Kim, Lee & Kyung, deep-frame-buffer relighting.
    """

    color: Float[Array, "height width 3"]
    shader: Int[Array, "height width"]
    ambient: Float[Array, "height width 3"]
    diffuse: Float[Array, "height width 3"]
    specular: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    depth: Float[Array, "height width"]
    roughness: Float[Array, "height width"]

    def __init__(
        self,
        color: Any,
        shader: Any,
        ambient: Any,
        diffuse: Any,
        specular: Any,
        normal: Any,
        depth: Any,
        roughness: Any,
    ):
        self.color = parameter("GBuffer(color)", color, None)
        shape = self.color.shape
        if len(shape) != 3 or shape[2] != 3:
            raise ValueError(
                f"`GBuffer(color)` must have shape (height, width, 3), got {shape}."
            )
        self.shader = as_array("GBuffer(shader)", shader)
        if self.shader.shape != shape[:2] or not jnp.issubdtype(self.shader.dtype, jnp.integer):
            raise ValueError(
                f"`GBuffer(shader)` must hold integers of shape {shape[:2]}, "
                f"got {self.shader.dtype} of shape {self.shader.shape}."
            )
        self.ambient = parameter("GBuffer(ambient)", ambient, shape)
        self.diffuse = parameter("GBuffer(diffuse)", diffuse, shape)
        self.specular = parameter("GBuffer(specular)", specular, shape)
        self.normal = parameter("GBuffer(normal)", normal, shape)
        self.depth = parameter("GBuffer(depth)", depth, shape[:2])
        self.roughness = share("GBuffer(roughness)", roughness, shape[:2])
