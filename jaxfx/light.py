"""Lights. `direction` is the way the light travels; colours are linear RGB."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._checks import check, parameter


__all__ = ["AmbientLight", "DirectionalLight", "Light", "PointLight", "SpotLight"]


def _direction(name: str, value: Any) -> Float[Array, "3"]:
    direction = parameter(name, value, (3,))
    check(name, direction, lambda v: v.any(), "a vector other than zero")
    return direction


@final
class AmbientLight(eqx.Module):
    """The same light from everywhere.

    **Arguments:** `color`: 3, linear RGB irradiance.

    **Raises:** `ValueError` for a wrong shape.

    **Gradient:** exact.
    """

    color: Float[Array, "3"]

    def __init__(self, color: Any):
        self.color = parameter("AmbientLight(color)", color, (3,))


@final
class DirectionalLight(eqx.Module):
    """A light from so far away that its rays are parallel: a sun.

    **Arguments:**

    - `direction`: 3, the way the light travels, in world space; any length but zero.
    - `color`: 3, linear RGB irradiance on a surface that faces it.

    **Raises:** `ValueError` for a wrong shape or a zero direction.

    **Gradient:** exact.
    """

    direction: Float[Array, "3"]
    color: Float[Array, "3"]

    def __init__(self, direction: Any, color: Any):
        self.direction = _direction("DirectionalLight(direction)", direction)
        self.color = parameter("DirectionalLight(color)", color, (3,))


@final
class PointLight(eqx.Module):
    """A light from a point, the same in every direction.

    **Arguments:**

    - `position`: 3, in world space.
    - `color`: 3, linear RGB intensity: irradiance at distance 1.

    **Raises:** `ValueError` for a wrong shape.

    **Gradient:** exact.
    """

    position: Float[Array, "3"]
    color: Float[Array, "3"]

    def __init__(self, position: Any, color: Any):
        self.position = parameter("PointLight(position)", position, (3,))
        self.color = parameter("PointLight(color)", color, (3,))


@final
class SpotLight(eqx.Module):
    """A light from a point into a cone: full inside `inner_angle`, none past `outer_angle`.

    **Arguments:**

    - `position`: 3, in world space.
    - `direction`: 3, the cone's axis, the way the light travels; any length but zero.
    - `color`: 3, linear RGB intensity on the axis.
    - `inner_angle`, `outer_angle`: radians from the axis, `0 <= inner_angle < outer_angle <=
      pi`.

    **Raises:** `ValueError` for a wrong shape, a zero direction or angles out of order.

    **Gradient:** exact.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    color: Float[Array, "3"]
    inner_angle: Float[Array, ""]
    outer_angle: Float[Array, ""]

    def __init__(
        self, position: Any, direction: Any, color: Any, inner_angle: Any, outer_angle: Any
    ):
        self.position = parameter("SpotLight(position)", position, (3,))
        self.direction = _direction("SpotLight(direction)", direction)
        self.color = parameter("SpotLight(color)", color, (3,))
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


Light = AmbientLight | DirectionalLight | PointLight | SpotLight
