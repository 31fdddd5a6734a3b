"""The deep frame buffer: the shading parameters of every pixel."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx._checks import as_array, parameter, share
from jaxfx._numerics import one_program


__all__ = ["GBuffer"]

# Reflectance at normal incidence of a dielectric of refractive index 1.5, as glTF 2.0 has it.
DIELECTRIC = 0.04


@final
class GBuffer(eqx.Module):
    """A cache of the eight shading parameters per pixel that do not depend on lights.

    Render a scene into it once, then shade it under any lights with `jaxfx.relight`. Positions
    follow from `depth` and the camera.

    **Arguments:** images of one height and width.

    - `color`: height width 3, base colour of the surface, linear RGB.
    - `shader`: height width, integers: -1 nothing, 0 Lambert, 1 Phong, 2 Blinn, 3 GGX (glTF's
      metallic-roughness: `GBuffer.metallic_roughness` makes one), 4 GGX that conserves energy.
    - `ambient`, `diffuse`, `specular`: height width 3, the linear RGB reflectances that
      ambient, diffuse and specular light are multiplied by (they include the base colour). Of
      GGX, `specular` is the reflectance straight on.
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

    @classmethod
    def metallic_roughness(
        cls, color: Any, metallic: Any, roughness: Any, normal: Any, depth: Any
    ) -> "GBuffer":
        """A cache of glTF's metallic-roughness material, which `relight` shades by GGX.

        Its eight images are the usual ones, so that a file or a painting tool needs no ninth.

        **Arguments:** images of one height and width.

        - `color`: height width 3, base colour, linear RGB.
        - `metallic`: height width, in [0, 1]: 1 a metal, 0 a dielectric of index 1.5.
        - `roughness`, `normal`, `depth`: as in `GBuffer`. Where the depth is missing or inf,
          the shader is -1.

        **Returns:** the `GBuffer`: `ambient` is `color`, `diffuse` is `color * (1 - metallic)`,
        `specular` mixes 0.04 and `color` by `metallic`.

        **Raises:** `ValueError` for a wrong shape, or a metallic or roughness outside [0, 1].
        Traced values are not checked.

        **Gradient:** exact with respect to every image.

        **Example:** a wall of rough gold:

        >>> import jax.numpy as jnp
        >>> from jaxfx import GBuffer
        >>> gold = jnp.broadcast_to(jnp.array([1.0, 0.75, 0.25]), (8, 8, 3))
        >>> one, facing = jnp.ones((8, 8)), jnp.zeros((8, 8, 3)).at[..., 2].set(-1)
        >>> wall = GBuffer.metallic_roughness(gold, one, one / 2, facing, 3 * one)
        >>> print(wall.specular[4, 4], wall.diffuse[4, 4], wall.shader[4, 4])
        [1.   0.75 0.25] [0. 0. 0.] 3

        Source: glTF 2.0 (Khronos 2017), 3.9.2 and appendix B.
        """
        name = "GBuffer.metallic_roughness"
        color = parameter(f"{name}(color)", color, None)
        if color.ndim != 3 or color.shape[2] != 3:
            raise ValueError(
                f"`{name}(color)` must have shape (height, width, 3), got {color.shape}."
            )
        depth = parameter(f"{name}(depth)", depth, color.shape[:2])
        metal = share(f"{name}(metallic)", metallic, color.shape[:2])
        roughness = share(f"{name}(roughness)", roughness, color.shape[:2])
        shader, diffuse, specular = _of_metal(color, metal, depth)
        return cls(
            color=color,
            shader=shader,
            ambient=color,
            diffuse=diffuse,
            specular=specular,
            normal=normal,
            depth=depth,
            roughness=roughness,
        )


@one_program
def _of_metal(
    color: Float[Array, "height width 3"],
    metal: Float[Array, "height width"],
    depth: Float[Array, "height width"],
) -> tuple[Array, Array, Array]:
    """The shader, the diffuse and the specular reflectance of metallic-roughness materials."""
    metal = metal.astype(color.dtype)[..., None]
    shader = jnp.where((depth > 0) & (depth < jnp.inf), 3, -1).astype(jnp.int32)
    return shader, color * (1 - metal), DIELECTRIC * (1 - metal) + color * metal
