"""A deep frame buffer along any rays, one a pixel: what mirrors show, say."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfx._checks import as_numpy
from jaxfx.camera import Rays
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import embree
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import meet, to_gbuffer
from jaxfx.scene._transfer import require_embree
from jaxfx.scene._view import View


# The space of the world, in which hits along rays are computed.
_WORLD = View(np.eye(3), np.eye(4), True)


def gbuffer_along(scene: Scene, rays: Rays) -> GBuffer:
    """The deep frame buffer along given rays: the first surface that each meets.

    Relight it by `relight.render(gbuffer, rays, lights)`. With `relight.mirrored` or
    `relight.refracted` it is what mirrors or clear bodies show, traced once for all lights.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `rays`: origins and directions, height width 3 each, in world axes. They may begin on a
      surface: 1e-4 of the scene's radius does not count. Where the direction is 0, or a number
      is not finite, there is no ray.

    **Returns:** a `GBuffer` of float32, as `gbuffer`'s; its `depth` is the distance along the
    ray, over the length of its direction. What meets nothing, or is no ray, is background:
    depth inf, shader -1 and zeros.

    **Raises:** `ValueError` for anything but a scene and rays of one shape; `RuntimeError`
    where Embree does not work.

    **Gradient:** none: this runs on the host, outside every transform.

    **Example:** rays of a camera give what the camera sees:

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> gbuffer = scene.gbuffer_along(mesh, camera.rays(height=6, width=8))
    >>> gbuffer.diffuse.shape, bool((gbuffer.depth > 0).all())
    ((6, 8, 3), True)

    Shadows at what it shows are traced by `visible` from `rays.origins + depth * directions`.
    Normals face the side from which the ray came.
    """
    name = "scene.gbuffer_along"
    if not isinstance(scene, Scene):
        raise ValueError(f"`{name}(scene)` must be a Scene, got {type(scene).__name__}.")
    require_embree("gbuffer_along")
    if not isinstance(rays, Rays):
        raise ValueError(f"`{name}(rays)` must be Rays, got {type(rays).__name__}.")
    origins, directions = (
        _field(f"{name}(rays.{field})", values)
        for field, values in zip(Rays._fields, rays, strict=True)
    )
    if origins.shape != directions.shape:
        raise ValueError(
            f"`{name}(rays)` must have origins and directions of one shape, got "
            f"{origins.shape} and {directions.shape}."
        )
    height, width, _ = origins.shape
    origins, directions = (field.reshape(-1, 3) for field in (origins, directions))
    length = np.linalg.norm(directions, axis=1)
    is_ray = np.isfinite(origins).all(axis=1) & np.isfinite(length) & (length > 0)
    pixel = np.flatnonzero(is_ray)
    start, toward = origins[pixel], directions[pixel]
    unit = toward / length[pixel, None]
    face = embree.first_along(scene, start, unit)
    is_hit = face >= 0
    pixel, face, start, toward = (each[is_hit] for each in (pixel, face, start, toward))
    both = start.T, toward.T
    hits = meet(scene, scene.vertices.T, pixel, face, both, toward.T)
    return to_gbuffer(scene, _WORLD, hits, height, width)


def _field(name: str, values: Any) -> Float[np.ndarray, "height width 3"]:
    """Origins or directions in float64."""
    array = as_numpy(name, values).astype(np.float64)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(f"`{name}` must have shape (height, width, 3), got {array.shape}.")
    return array
