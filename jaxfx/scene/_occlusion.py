"""Of every pixel: how much of the light from all around arrives, direction by direction."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._arguments import OCCLUSION_COUNTS, check_camera, check_gbuffer
from jaxfx._checks import whole_number
from jaxfx._harmonics import FACTORS, LEFT, polynomials
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import embree
from jaxfx.scene._scene import Scene
from jaxfx.scene._transfer import require_embree


# Rays cast at once: bounds the memory of a block of pixels.
_RAYS_PER_BLOCK = 1 << 18
# Length of a ray, over the scene's radius: from any point of a scene it ends outside.
_REACH = 4.0


def occlusion(
    scene: Scene,
    gbuffer: GBuffer,
    camera: Camera,
    *,
    ray_count: int = 64,
    degree: int = 3,
    seed: int = 0,
) -> Float[Array, "height width coefficient"]:
    """The shadows of light from all around, as a few numbers per pixel, whatever the light.

    Trace it once; `relight` takes it as the visibility of a `SphericalHarmonicsLight` or an
    `EnvironmentLight`. To turn the surroundings is then an edit of one light.

    **Arguments:**

    - `scene`: the scene that the cache shows.
    - `gbuffer`, `camera`: the cache, height width, and its camera.
    - `ray_count`: rays per pixel. The error falls about as one over it, to the square root.
    - `degree`: of the spherical harmonics: 2 gives nine numbers a pixel, 3 sixteen, which are
      much better.
    - `seed`: of the turns of the rays from pixel to pixel.

    **Returns:** height width coefficient, float32; 0 where nothing is seen.

    **Raises:** `ValueError` for a count or degree out of range; `RuntimeError` where Embree
    does not work.

    **Gradient:** none: this runs on the host, outside every transform.

    **Example:** the share of a white sky that arrives:

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> gbuffer = scene.gbuffer(mesh, camera, height=6, width=8)
    >>> occlusion = scene.occlusion(mesh, gbuffer, camera, ray_count=16)
    >>> share = occlusion[..., 0] / occlusion[..., 0].max()
    >>> occlusion.shape, bool(share.min() < 0.6)
    ((6, 8, 16), True)

    With V(w) 1 where nothing lies in direction w, else 0, N the normal and Y the functions, a
    pixel is the integrals of `V(w) * max(N.w, 0) * Y(w) / pi`: times the light's coefficients
    and summed, it is what a white Lambert surface shows. Rays are spread by the cosine; only
    those that are blocked count: a pixel that sees all the sky has no noise.

    Shadows of a small lamp or a sun in the surroundings are as soft as the functions are. The
    scene's surfaces block light, they send none on: `transfer` does.

    Source: Sloan, Kautz & Snyder 2002, equation 8; to sum over blocked rays is our own.
    """
    require_embree("occlusion")
    check_camera("scene.occlusion(camera)", camera)
    gbuffer = check_gbuffer("scene.occlusion(gbuffer)", gbuffer)
    name, is_degree = "scene.occlusion(degree=...)", lambda n: n in (2, 3)
    count = OCCLUSION_COUNTS[whole_number(name, degree, is_degree, "2 or 3") - 2]
    name = "scene.occlusion(ray_count=...)"
    ray_count = whole_number(name, ray_count, lambda n: n >= 1, "an integer from 1")
    depth = np.asarray(gbuffer.depth)
    is_surface = np.isfinite(depth) & (depth > 0) & (np.asarray(gbuffer.shader) >= 0)
    is_surface &= np.asarray(gbuffer.normal).any(axis=-1)
    height, width = depth.shape
    pixels = pixel_centers(height, width, gbuffer.depth.dtype)
    position = np.asarray(camera.unproject(pixels, gbuffer.depth), np.float64)[is_surface]
    normal = np.asarray(gbuffer.normal, np.float64)[is_surface]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    found = _functions(normal, count) * LEFT[:count]
    rng, step = np.random.default_rng(seed), max(_RAYS_PER_BLOCK // ray_count, 1)
    for first in range(0, len(position), step):
        block = slice(first, first + step)
        directions = _about(normal[block], ray_count, rng)
        start = np.broadcast_to(position[block, None], directions.shape).reshape(-1, 3)
        end = start + _REACH * scene.radius * directions.reshape(-1, 3)
        is_blocked = ~embree.unobstructed(scene, start, end).reshape(directions.shape[:2])
        found[block] -= (_functions(directions, count) * is_blocked[..., None]).mean(axis=1)
    image = np.zeros((height, width, count), np.float32)
    image[is_surface] = found
    return jnp.asarray(image)


def _functions(direction: Any, count: int) -> Float[np.ndarray, "... count"]:
    """The first spherical harmonics of unit vectors."""
    return np.stack(polynomials(direction)[:count], axis=-1) * FACTORS[:count]


def _about(
    normal: Float[np.ndarray, "pixel 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "pixel direction 3"]:
    """Directions about each normal, spread by the cosine.

    One even pattern in a square, moved by another offset in each pixel, is mapped to the disc
    below the half sphere (Malley).
    """
    steps = np.arange(count) + 0.5
    pattern = np.stack([steps / count, steps * (np.sqrt(5) - 1) / 2], axis=-1)
    square = (pattern + rng.random((len(normal), 1, 2))) % 1
    radius, angle = np.sqrt(square[..., 0]), 2 * np.pi * square[..., 1]
    # An axis that is not nearly the normal, made perpendicular to it.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=-1)]
    u = np.cross(normal, axis)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(normal, u)
    along = [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)]
    return np.einsum("kpw,kpi->pwi", np.stack(along), np.stack([u, v, normal]))
