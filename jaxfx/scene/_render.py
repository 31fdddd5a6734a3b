"""The public functions that render a scene: to a deep frame buffer, depth, or ids.

A backend finds the face that each pixel shows; `_surface` computes what the surface is like.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfx._checks import whole_number
from jaxfx.camera import Camera
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import embree, opengl
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import Hits, depth_image, intersect, to_gbuffer
from jaxfx.scene._view import View, check_size


_logger = logging.getLogger("jaxfx.scene")
_FirstFaces = Callable[[Scene, View, np.ndarray], np.ndarray]
_BACKENDS = {"opengl": opengl, "embree": embree}
# A warning is logged where the camera's position is rounded by more than this, relative to the
# scene's radius: at that size, misplaced pixels become visible.
_POSITION_ROUNDING = 1e-3
# Where the search for the next layer begins behind the last one, relative to the sum of its
# depth and the scene's radius. Less finds the last layer again, by rounding; more skips thin
# gaps.
_LAYER_GAP = 1e-5


def gbuffer(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> GBuffer:
    """The deep frame buffer of a scene: shading parameters at each pixel's centre.

    `relight.render` lights it. It is not antialiased.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `camera`: a `PinholeCamera`, with any intrinsics, or an `OrthographicCamera`.
    - `height`, `width`: image size in pixels.
    - `backend`: "opengl" rasterises; "embree" casts rays; "auto" takes OpenGL where it works,
      else Embree, and logs which to `jaxfx.scene`.
    - `layer_index`: 0 is what the camera sees; 1 the next surface behind it that shows its
      front (its corners counter-clockwise), and so on. Surfaces closer together than about
      1e-5 of their depth plus the scene's radius may count as one.

    **Returns:** a `GBuffer` of float32. Background pixels have depth inf, shader -1 and zeros.

    **Raises:** `ValueError` for arguments out of range, and where layer 0 shows nothing at
    all; `RuntimeError` where the backend does not work on this machine.

    **Gradient:** none, with respect to the camera or anything else: this runs on the host,
    outside every transform.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> scene.gbuffer(mesh, camera, height=6, width=8).diffuse.shape
    (6, 8, 3)

    The base colour is texture x factor x vertex colour, in linear light. `ambient` is the base
    colour, `diffuse` is `base * (1 - metallic)`, `specular` mixes 0.04 and the base colour by
    `metallic`. The shader is 3, GGX, for a `Material` of that shader, as those of glTF files
    are, 4 for one that conserves energy; for others Lambert where roughness is 1 and metallic
    0, Blinn elsewhere. Normals include the normal map, and face the camera, whichever side of a
    face is seen.
    """
    view, hits, size = _visible("gbuffer", scene, camera, height, width, backend, layer_index)
    if layer_index == 0 and len(hits.pixel) == 0:
        raise ValueError(
            "`scene.gbuffer(camera)` must see the scene, got nothing in view: the scene lies "
            f"about {np.round(scene.center, 3).tolist()}, "
            f"{np.round(scene.extent, 3).tolist()} in size."
        )
    return to_gbuffer(scene, view, hits, *size)


def depth(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Float[Array, "height width"]:
    """The depth of what each pixel's centre shows, along the optical axis: a shadow map, say.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, float32, scene units; inf for background.

    **Raises:** as `gbuffer`, except that a camera which sees nothing gives inf everywhere.

    **Gradient:** none: this runs on the host, outside every transform.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> print(scene.depth(mesh, camera, height=6, width=8).max().round(1))
    8.0
    """
    _, hits, size = _visible("depth", scene, camera, height, width, backend, layer_index)
    return jnp.asarray(depth_image(hits, *size))


def object_ids(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Int[Array, "height width"]:
    """The object that each pixel's centre shows, as an index into the scene's `names`.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, int32; -1 for background.

    **Raises:** as `depth`.

    **Gradient:** none: these are integers.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> mesh.names[scene.object_ids(mesh, camera, height=6, width=8)[0, 0]]
    'wall'
    """
    _, hits, size = _visible("object_ids", scene, camera, height, width, backend, layer_index)
    return _ids(hits, scene.face_objects, size)


def material_ids(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Int[Array, "height width"]:
    """The material that each pixel's centre shows, as an index into the scene's `materials`.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, int32; -1 for background.

    **Raises:** as `depth`.

    **Gradient:** none: these are integers.

    **Example:**

    >>> from jaxfx import scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> index = scene.material_ids(mesh, camera, height=6, width=8)[0, 0]
    >>> mesh.materials[index].roughness
    1.0
    """
    _, hits, size = _visible("material_ids", scene, camera, height, width, backend, layer_index)
    return _ids(hits, scene.face_materials, size)


def _ids(
    hits: Hits, of_face: Int[np.ndarray, " face"], size: tuple[int, int]
) -> Int[Array, "height width"]:
    """An image of the hit faces' entries in `of_face`; -1 for background."""
    ids = np.full(size, -1, np.int32)
    ids.flat[hits.pixel] = of_face[hits.face]
    return jnp.asarray(ids)


def _visible(
    caller: str,
    scene: Any,
    camera: Any,
    height: Any,
    width: Any,
    backend: Any,
    layer_index: Any,
) -> tuple[View, Hits, tuple[int, int]]:
    """The checked view, its hits on layer `layer_index`, and the image's height and width."""
    height, width = check_size(caller, height, width)
    view = View.of(camera, f"scene.{caller}")
    if not isinstance(scene, Scene):
        raise ValueError(
            f"`scene.{caller}(scene)` must be a Scene, got {type(scene).__name__}."
        )
    name, expected = f"scene.{caller}(layer_index=...)", "an integer from 0"
    layer_index = whole_number(name, layer_index, lambda n: n >= 0, expected)
    _warn_of_rounding(scene, camera, caller)
    first_faces = _backend(caller, backend)
    hits = intersect(scene, view, first_faces(scene, view, np.zeros((height, width))))
    for _ in range(layer_index):
        faces = _next_faces(first_faces, scene, view, hits, (height, width))
        hits = intersect(scene, view, faces)
    return view, hits, (height, width)


def _warn_of_rounding(scene: Scene, camera: Camera, caller: str) -> None:
    """Log a warning where the camera's float type can't hold its position well enough."""
    pose = np.asarray(camera.world_from_camera)
    rounding = float(np.spacing(np.abs(pose[:3, 3]).max())) / 2
    if rounding > _POSITION_ROUNDING * scene.radius:
        _logger.warning(
            "scene.%s(camera): the camera's position is rounded to %.2g in %s, where the scene "
            "is %.2g in size: move both to the origin, or set jax_enable_x64",
            caller,
            rounding,
            pose.dtype,
            2 * scene.radius,
        )


def _next_faces(
    first_faces: _FirstFaces, scene: Scene, view: View, hits: Hits, shape: tuple[int, int]
) -> Int[np.ndarray, "height width"]:
    """The next face behind each hit that shows its front; -1 where there is none.

    A ray that meets a back face continues from there. One that, by rounding, meets a face
    before its start continues too, with a doubled gap.
    """
    faces = np.full(shape, -1, np.int32)
    gap = np.full(shape, _LAYER_GAP)
    last_depth = np.full(shape, np.inf)
    last_depth.flat[hits.pixel] = hits.depth
    while np.isfinite(last_depth).any():
        start = last_depth + gap * (last_depth + scene.radius)
        next_hits = intersect(scene, view, first_faces(scene, view, start))
        pixel, start_depth = next_hits.pixel, start.flat[next_hits.pixel]
        is_past = next_hits.depth > start_depth
        is_done = is_past & next_hits.front
        faces.flat[pixel[is_done]] = next_hits.face[is_done]
        gap.flat[pixel[~is_past]] *= 2
        last_depth = np.full(shape, np.inf)
        last_depth.flat[pixel[~is_done]] = np.maximum(next_hits.depth, start_depth)[~is_done]
    return faces


def _backend(caller: str, name: str) -> _FirstFaces:
    """The `first_faces` of a backend by name; an error names `caller`."""
    if name == "auto":
        name = _automatic()
    if name not in _BACKENDS:
        raise ValueError(
            f'`scene.{caller}(backend=...)` must be "auto", "opengl" or "embree", got {name!r}.'
        )
    problem = _BACKENDS[name].problem()
    if problem:
        raise RuntimeError(
            f'`scene.{caller}(backend="{name}")` does not work on this machine: {problem}'
        )
    return _BACKENDS[name].first_faces


@functools.cache
def _automatic() -> str:
    """The name of the first backend that works, which is logged once."""
    problems = {}
    for name, module in _BACKENDS.items():
        problems[name] = module.problem()
        if problems[name] is None:
            refused = "".join(f" ({key}: {why})" for key, why in problems.items() if why)
            _logger.info("scenes are rendered with %s%s", name, refused)
            return name
    reasons = "; ".join(f"{name}: {why}" for name, why in problems.items())
    raise RuntimeError(f"no backend of `jaxfx.scene` works on this machine: {reasons}.")
