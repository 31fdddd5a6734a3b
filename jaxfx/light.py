"""Lights. `direction` is that in which the light travels; colours are linear RGB.

| I want | make |
|---|---|
| the same light from everywhere, without shadows | `AmbientLight(color)` |
| a sun | `DirectionalLight(direction, color)` |
| a lamp | `PointLight(position, color)` |
| a lamp that shines into a cone | `SpotLight(position, direction, color, ...)` |
| a light with an extent, for soft shadows | any of these three with a `light_size` |
| soft light from all around, without highlights | `SphericalHarmonicsLight(coefficients)` |
| the surroundings, from an image of all directions | `EnvironmentLight(image)` |
"""

from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx import _environment
from jaxfx._checks import check, parameter
from jaxfx._numerics import working_dtype


__all__ = [
    "AmbientLight",
    "DirectionalLight",
    "EnvironmentLight",
    "Light",
    "PointLight",
    "SphericalHarmonicsLight",
    "SpotLight",
]


def _vector(name: str, value: Any) -> Float[Array, "3"]:
    """Three finite numbers; `ValueError` otherwise."""
    vector = parameter(name, value, (3,))
    check(name, vector, np.isfinite, "finite")
    return vector


def _color(name: str, value: Any) -> Float[Array, "3"]:
    """Three numbers, of any sign, inf included; `ValueError` for a NaN."""
    color = parameter(name, value, (3,))
    check(name, color, lambda v: ~np.isnan(v), "three numbers")
    return color


def _direction(name: str, value: Any) -> Float[Array, "3"]:
    """A vector that is not zero, of any length; `ValueError` otherwise."""
    direction = _vector(name, value)
    check(name, direction, lambda v: v.any(), "a vector other than zero")
    return direction


def _light_size(name: str, value: Any) -> Float[Array, ""] | None:
    """A size above 0, or None for a light without an extent; `ValueError` otherwise."""
    if value is None:
        return None
    light_size = parameter(name, value)
    check(name, light_size, lambda v: (v > 0) & (v < np.inf), "positive, or None")
    return light_size


@final
class AmbientLight(eqx.Module):
    """The same light from everywhere: it casts no shadows and has no highlights.

    **Arguments:** `color`: 3, linear RGB irradiance.

    **Raises:** `ValueError` for a wrong shape or a NaN.

    **Gradient:** exact.

    **Example:**

    >>> from jaxfx import AmbientLight
    >>> print(AmbientLight(color=[0.5, 0.5, 0.25]).color)
    [0.5  0.5  0.25]
    """

    SHAPES: ClassVar = {"color": (3,)}

    color: Float[Array, "3"]

    def __init__(self, color: Any):
        self.color = _color("AmbientLight(color)", color)


@final
class DirectionalLight(eqx.Module):
    """A light so far away that its rays are parallel: a sun.

    **Arguments:**

    - `direction`: 3, in which the light travels, in world space; any length but zero.
    - `color`: 3, linear RGB irradiance on a surface that faces it.
    - `light_size`: how wide it appears, in radians; None for no extent. Shadows alone read it:
      `shadow.MovingShadow`, or your own call of `shadow.pcss`.

    **Raises:** `ValueError` for a wrong shape, a number that is not finite, a zero direction or
    a size that is not positive.

    **Gradient:** exact.

    **Example:** a noon sun, where y points up:

    >>> from jaxfx import DirectionalLight
    >>> sun = DirectionalLight(direction=[0, -1, 0], color=[3, 3, 3])
    >>> print(sun.direction)
    [ 0. -1.  0.]
    """

    SHAPES: ClassVar = {"direction": (3,), "color": (3,)}

    direction: Float[Array, "3"]
    color: Float[Array, "3"]
    light_size: Float[Array, ""] | None

    def __init__(self, direction: Any, color: Any, light_size: Any = None):
        self.direction = _direction("DirectionalLight(direction)", direction)
        self.color = _color("DirectionalLight(color)", color)
        self.light_size = _light_size("DirectionalLight(light_size)", light_size)


@final
class PointLight(eqx.Module):
    """A light at a point, of the same intensity in every direction.

    **Arguments:**

    - `position`: 3, in world space.
    - `color`: 3, linear RGB intensity: irradiance at distance 1.
    - `light_size`: its diameter, in scene units; None for no extent. Shadows alone read it:
      shading takes the light for a point.

    **Raises:** `ValueError` for a wrong shape, a number that is not finite or a size that is
    not positive.

    **Gradient:** exact.

    **Example:**

    >>> from jaxfx import PointLight
    >>> lamp = PointLight(position=[0, 2, 0], color=[8, 8, 4])
    >>> print(lamp.color)
    [8. 8. 4.]
    """

    SHAPES: ClassVar = {"position": (3,), "color": (3,)}

    position: Float[Array, "3"]
    color: Float[Array, "3"]
    light_size: Float[Array, ""] | None

    def __init__(self, position: Any, color: Any, light_size: Any = None):
        self.position = _vector("PointLight(position)", position)
        self.color = _color("PointLight(color)", color)
        self.light_size = _light_size("PointLight(light_size)", light_size)


@final
class SpotLight(eqx.Module):
    """A light at a point that shines into a cone.

    Full inside `inner_angle`, fading smoothly to none at `outer_angle`.

    **Arguments:**

    - `position`: 3, in world space.
    - `direction`: 3, the cone's axis, in which the light travels; any length but zero.
    - `color`: 3, linear RGB intensity on the axis.
    - `inner_angle`, `outer_angle`: radians from the axis, `0 <= inner_angle < outer_angle <=
      pi`.
    - `light_size`: its diameter, in scene units, as of a `PointLight`.

    **Raises:** `ValueError` for a wrong shape, a number that is not finite, a zero direction, a
    size that is not positive or angles out of order. Traced values are not checked: a cone
    whose angles are out of order is dark.

    **Gradient:** exact.

    **Example:**

    >>> from jaxfx import SpotLight
    >>> angles = {"inner_angle": 0.4, "outer_angle": 0.5}
    >>> spot = SpotLight([0, 3, 0], [0, -1, 0], color=[9, 9, 9], **angles)
    >>> print(spot.position, spot.direction)
    [0. 3. 0.] [ 0. -1.  0.]
    """

    SHAPES: ClassVar = {
        **dict.fromkeys(("position", "direction", "color"), (3,)),
        **dict.fromkeys(("inner_angle", "outer_angle"), ()),
    }

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    color: Float[Array, "3"]
    inner_angle: Float[Array, ""]
    outer_angle: Float[Array, ""]
    light_size: Float[Array, ""] | None

    def __init__(
        self,
        position: Any,
        direction: Any,
        color: Any,
        inner_angle: Any,
        outer_angle: Any,
        light_size: Any = None,
    ):
        self.position = _vector("SpotLight(position)", position)
        self.direction = _direction("SpotLight(direction)", direction)
        self.color = _color("SpotLight(color)", color)
        self.inner_angle = parameter("SpotLight(inner_angle)", inner_angle)
        self.outer_angle = parameter("SpotLight(outer_angle)", outer_angle)
        check("SpotLight(inner_angle)", self.inner_angle, lambda v: v >= 0, "0 or positive")
        check("SpotLight(outer_angle)", self.outer_angle, lambda v: v <= jnp.pi, "at most pi")
        width = self.outer_angle - self.inner_angle
        check(
            "SpotLight(outer_angle)",
            width,
            lambda v: v > 0,
            "above `inner_angle` (outer_angle - inner_angle > 0)",
        )
        self.light_size = _light_size("SpotLight(light_size)", light_size)


@final
class SphericalHarmonicsLight(eqx.Module):
    """Soft light from all around, as nine numbers for each channel.

    A matt surface hardly tells it from the surroundings that it stands for, if no sun is in
    them. It has no highlights; the image is linear in the coefficients.

    **Arguments:** `coefficients`: 9 3, linear RGB: of the radiance that comes from each
    direction, in world space, in terms of the real orthonormal spherical harmonics of that
    direction, by degree and order: 1; y, z, x; xy, yz, 3zz - 1, xz, xx - yy.

    **Raises:** `ValueError` for a wrong shape or a number that is not finite.

    **Gradient:** exact.

    **Example:** the same from everywhere, and somewhat more from above:

    >>> import jax.numpy as jnp
    >>> from jaxfx import SphericalHarmonicsLight
    >>> same = jnp.zeros((9, 3)).at[0].set((4 * jnp.pi) ** 0.5)
    >>> sky = SphericalHarmonicsLight(same.at[1].set(0.5))
    >>> sky.coefficients.shape
    (9, 3)

    With c the coefficients, Y the functions and N the normal, a pixel is `diffuse * sum(A * c *
    Y(N))`, A being 1, 2/3 and 1/4 of degrees 0, 1 and 2. Of a GGX surface, `diffuse` is less
    what the highlight takes, averaged over all directions.

    Radiance that changes sharply, a sun say, is not well told by nine numbers: the light then
    is negative on the side away from it. Nothing is cut off there, so that all stays linear.

    Source: Ramamoorthi & Hanrahan 2001; that GGX loses is our own.
    """

    SHAPES: ClassVar = {"coefficients": (9, 3)}

    coefficients: Float[Array, "9 3"]

    def __init__(self, coefficients: Any):
        name = "SphericalHarmonicsLight(coefficients)"
        self.coefficients = parameter(name, coefficients, (9, 3))
        check(name, self.coefficients, np.isfinite, "finite")


@final
class EnvironmentLight(eqx.Module):
    """The surroundings, from an image of all directions: a sky, a room, a panorama.

    Matt surfaces get a blur of it by the cosine, GGX surfaces highlights from blurs by their
    lobe as well. All are made once, here: to turn the surroundings (`turned`) costs nothing.

    **Arguments:**

    - `image`: height width 3, twice as wide as high, linear RGB radiance: the image is
      equirectangular, row 0 is straight up. Of the image's axes y is up, the middle column
      looks along -z, the right half lies at +x.
    - `world_from_image`: 3 3, a rotation from the image's axes to the world's; None where they
      are the same, as for a mesh file with y up.
    - `color`: 3, which multiplies the image.

    **Raises:** `ValueError` for another shape, a radiance that is negative, NaN or inf, or a
    `world_from_image` that is no rotation to 1e-3.

    **Gradient:** exact, through both approximations, with respect to `image`,
    `world_from_image` and `color`. It jumps where a normal or a mirrored direction passes from
    texel to texel.

    **Example:** bright above, dark below:

    >>> import numpy as np
    >>> from jaxfx import EnvironmentLight
    >>> sky = np.ones((16, 32, 3)) * np.linspace(1, 0, 16)[:, None, None]
    >>> light = EnvironmentLight(sky)
    >>> light.coefficients.shape, light.heights[:2]
    ((16, 3), (16, 16))

    - `coefficients`: 16 3, in the image's axes; the first nine as in `SphericalHarmonicsLight`,
      then y(3xx - yy), xyz, y(5zz - 1), z(5zz - 3), x(5zz - 1), z(xx - yy), x(xx - 3yy).
      Shadows from all around (`scene.occlusion`) read them, nothing else.
    - `pyramid`, `heights`: the texels of all blurs, and how many rows each has.

    A highlight is the split sum of two round lobes: at grazing angles a true one is drawn out.
    Lambert, Phong and Blinn surfaces get diffuse light alone. A visibility of height width is
    one number for all directions; that of `scene.occlusion` tells them apart.

    Source: Karis 2013, the split sum; Ramamoorthi & Hanrahan 2001. The second lobe is our own.
    """

    SHAPES: ClassVar = {"color": (3,), "world_from_image": (3, 3), "coefficients": (16, 3)}

    color: Float[Array, "3"]
    world_from_image: Float[Array, "3 3"]
    coefficients: Float[Array, "16 3"]
    pyramid: Float[Array, "texel 3"]
    heights: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, image: Any, world_from_image: Any = None, color: Any = (1.0, 1.0, 1.0)):
        image = parameter("EnvironmentLight(image)", image, None)
        height = image.shape[0] if image.ndim == 3 else 0
        if height == 0 or image.shape != (height, 2 * height, 3):
            raise ValueError(
                "`EnvironmentLight(image)` must have shape (height, 2 * height, 3), "
                f"got {image.shape}."
            )
        is_radiance = lambda v: np.isfinite(v) & (v >= 0)
        check("EnvironmentLight(image)", image, is_radiance, "finite, 0 or positive")
        image = image.astype(working_dtype(image.dtype))
        self.color = _color("EnvironmentLight(color)", color)
        if world_from_image is None:
            world_from_image = np.eye(3)
        self.world_from_image = _rotation(
            "EnvironmentLight(world_from_image)", world_from_image
        )
        self.heights = _environment.heights(height)
        self.coefficients = jax.jit(_environment.coefficients)(image)
        self.pyramid = jax.jit(_environment.blurs)(image)

    def turned(self, world_from_image: Any) -> "EnvironmentLight":
        """The same surroundings, turned otherwise; nothing is blurred again.

        **Arguments:** `world_from_image`: 3 3, a rotation from the image's axes to the
        world's.

        **Returns:** the new `EnvironmentLight`.

        **Raises:** `ValueError` for another shape, or what is no rotation to 1e-3.

        **Gradient:** exact.
        """
        turn = _rotation("turned(world_from_image)", world_from_image)
        return eqx.tree_at(lambda light: light.world_from_image, self, turn)


def _rotation(name: str, value: Any) -> Float[Array, "3 3"]:
    """A matrix that turns; `ValueError` otherwise."""
    rotation = parameter(name, value, (3, 3))
    is_turn = lambda v: (
        np.allclose(v @ v.T, np.eye(3), atol=1e-3) and np.linalg.det(v.astype(float)) > 0
    )
    check(name, rotation, is_turn, "a rotation")
    return rotation


Light = (
    AmbientLight
    | DirectionalLight
    | PointLight
    | SpotLight
    | SphericalHarmonicsLight
    | EnvironmentLight
)
