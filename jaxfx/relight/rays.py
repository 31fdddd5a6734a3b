"""Rays that leave a cached surface, mirrored or refracted, and how much light goes each way."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._arrays import ArrayLike
from jaxfx._checks import check, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, clip01, safe_divide, safe_sqrt
from jaxfx.camera import OrthographicCamera, PinholeCamera, Rays
from jaxfx.gbuffer import GBuffer
from jaxfx.relight.shading import Surface, check_cache, to_surface


@on_any_mesh
def mirrored(gbuffer: GBuffer, camera: PinholeCamera | OrthographicCamera | Rays) -> Rays:
    """The rays along which each pixel's surface shows its surroundings, were it a mirror.

    `scene.gbuffer_along` traces them once, as a second cache; `render` of that cache and these
    rays, times `fresnel`, is what the mirrors add to the image under any lights.

    **Arguments:** `gbuffer`, `camera`: as in `shade`; the rays of a second cache give those of
    a third.

    **Returns:** `Rays`: origins on the surface, unit directions; height width 3, in the type of
    `gbuffer.color`. Both are 0 where there is no surface.

    **Raises:** `ValueError` as `shade` does.

    **Gradient:** exact with respect to `gbuffer.normal`, `gbuffer.depth` and the camera.

    **Example:** a wall that faces the camera shows what is behind the camera:

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> rays = relight.mirrored(wall, OrthographicCamera(1.0, [4, 4], jnp.eye(4)))
    >>> print(rays.origins[4, 4], rays.directions[4, 4])
    [0.5 0.5 3. ] [ 0.  0. -1.]

    The direction is D - 2 (D.N) N, with D that of the ray to the pixel. Normals face the
    camera, whichever side of a face is seen.

    Source: Whitted 1980, section 2; rays kept as a cache are Kim, Lee & Kyung's future work.
    """
    gbuffer = check_cache("mirrored", gbuffer, camera)
    return _mirrored(gbuffer, camera)


@on_any_mesh
def refracted(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera | Rays,
    *,
    index: Float[ArrayLike, "..."] | float = 1.5,
) -> Rays:
    """The rays along which light goes on behind each pixel's surface, were it clear.

    `scene.gbuffer_along` traces them. Through a body of glass there are two: into it by an
    index of 1.5, and from the cache along those rays out of it by 1 / 1.5.

    **Arguments:**

    - `gbuffer`, `camera`: as in `mirrored`.
    - `index`: a ratio, one number or height width: the index of refraction behind the surface
      over that before it.

    **Returns:** `Rays`, as `mirrored`. Where all light is reflected (total internal reflection:
    the sine of the angle to the normal is above `index`) both are 0, and the cache along them
    shows nothing there.

    **Raises:** `ValueError` as `shade` does, and for an index that is not positive.

    **Gradient:** exact with respect to `index`, `gbuffer.normal`, `gbuffer.depth` and the
    camera; zero where all light is reflected.

    **Example:** straight through a surface seen straight on:

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> rays = relight.refracted(wall, OrthographicCamera(1.0, [4, 4], jnp.eye(4)))
    >>> print(rays.origins[4, 4], rays.directions[4, 4, 2])
    [0.5 0.5 3. ] 1.0

    Snell's law: the sine of the angle to the normal is divided by `index`. That radiance is
    denser in matter, by `index` squared, is left out: it cancels where the light comes out.

    Source: Whitted 1980, section 2; Snell's law as Heckbert 1989 writes it.
    """
    gbuffer = check_cache("refracted", gbuffer, camera)
    return _refracted(gbuffer, camera, _index("refracted", index, gbuffer))


@on_any_mesh
def fresnel(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera | Rays,
    *,
    index: Float[ArrayLike, "..."] | float | None = None,
) -> Float[Array, "height width 3"]:
    """The share of light that each pixel's surface mirrors; the rest goes on, or is diffuse.

    It weighs the image of a cache along `mirrored` rays; one minus it that of `refracted` ones.

    **Arguments:**

    - `gbuffer`, `camera`: as in `mirrored`.
    - `index`: as in `refracted`, for clear matter. None takes `gbuffer.specular` for the share
      straight on, as the shader GGX does.

    **Returns:** height width 3, ratios, in the type of `gbuffer.color`; 0 where there is no
    surface, 1 where all light is reflected.

    **Raises:** `ValueError` as `refracted` does.

    **Gradient:** exact with respect to `index`, `gbuffer.specular`, `gbuffer.normal` and the
    camera; zero where all light is reflected.

    **Example:** glass seen straight on mirrors a twenty-fifth:

    >>> import jax.numpy as jnp
    >>> from jaxfx import GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> print(relight.fresnel(wall, camera, index=1.5)[4, 4].round(3))
    [0.04 0.04 0.04]

    With an index, the mean of Fresnel's two polarisations. Without, `specular + (1 - specular)
    * (1 - N.V)**5`; of a surface without highlights `specular` counts as 0.

    It is for surfaces as smooth as a mirror: what a rough one shows is blurred, which no ray
    per pixel can be. A G-buffer's roughness says which those are.

    Source: Fresnel's equations, as in Born & Wolf 1999, 1.5.2; Schlick 1994, equation 15.
    """
    gbuffer = check_cache("fresnel", gbuffer, camera)
    ratio = None if index is None else _index("fresnel", index, gbuffer)
    return _fresnel(gbuffer, camera, ratio)


def _index(function: str, index: Any, gbuffer: GBuffer) -> Float[Array, "#height #width"]:
    """An index of refraction that broadcasts over pixels."""
    name = f"{function}(index=...)"
    array = parameter(name, index, None)
    if array.ndim:
        array = parameter(name, array, gbuffer.depth.shape)
    check(name, array, lambda v: (v > 0) & (v < np.inf), "positive")
    return array if array.ndim else array[None, None]


@jax.jit
def _mirrored(gbuffer, camera):
    surface = to_surface(gbuffer, camera, kinds=1)
    facing = _facing(surface)[..., None]
    directions = 2 * facing * surface.normal - surface.to_camera
    return _rays(gbuffer, surface, directions, jnp.ones(facing.shape, bool))


@jax.jit
def _refracted(gbuffer, camera, index):
    surface = to_surface(gbuffer, camera, kinds=1)
    index = index.astype(surface.position.dtype)
    facing = _facing(surface)
    cosine, passes = _behind(facing, index)
    along = (facing / index - cosine)[..., None]
    directions = along * surface.normal - surface.to_camera / index[..., None]
    return _rays(gbuffer, surface, directions, passes[..., None])


def _facing(surface: Surface) -> Float[Array, "height width"]:
    """N.V; normals face the camera, but for rounding."""
    assert surface.facing is not None
    return surface.facing


def _rays(gbuffer: GBuffer, surface: Surface, directions: Array, passes: Array) -> Rays:
    """The rays from the surface, in the type of the cache; 0 where there are none."""
    is_ray = (surface.shader >= 0)[..., None] & passes
    origins, directions = (
        jnp.where(is_ray, field, 0).astype(gbuffer.color.dtype)
        for field in (surface.position, directions)
    )
    return Rays(origins, directions)


def _behind(facing: Array, index: Array) -> tuple[Array, Array]:
    """The cosine of the refracted ray to the normal, and whether there is one."""
    square = 1 - (1 - facing * facing) / (index * index)
    passes = square > 0
    return safe_sqrt(jnp.where(passes, square, 0)), passes


@jax.jit
def _fresnel(gbuffer, camera, index):
    surface = to_surface(gbuffer, camera, kinds=1)
    facing = absolute(_facing(surface))
    if index is None:
        grazing = (1 - clip01(facing)) ** 5
        share = surface.specular + (1 - surface.specular) * grazing[..., None]
    else:
        index = index.astype(facing.dtype)
        cosine, passes = _behind(facing, index)
        ratio = lambda a, b: safe_divide(a - b, a + b) ** 2
        mean = (ratio(facing, index * cosine) + ratio(index * facing, cosine)) / 2
        share = jnp.where(passes, mean, 1)[..., None]
        share = jnp.broadcast_to(share, gbuffer.color.shape)
    share = jnp.where((surface.shader >= 0)[..., None], share, 0)
    return share.astype(gbuffer.color.dtype)
