"""The public calls: a scene and a camera to a deep frame buffer, depth, or object ids."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfx._checks import whole_number
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.scene import embree, opengl
from jaxfx.scene._scene import Scene
from jaxfx.scene._surface import Hits, depth_image, intersect, to_gbuffer
from jaxfx.scene._view import View, check_size


_logger = logging.getLogger("jaxfx.scene")
_Camera = PinholeCamera | OrthographicCamera
_FirstFaces = Callable[[Scene, View, np.ndarray], np.ndarray]
_BACKENDS = {"opengl": opengl, "embree": embree}
_COARSE = 1e-3  # of the scene's radius: a rounding of the camera's place to speak of
_GAP = 1e-5  # between layers, of their depth and of the scene's radius


def gbuffer(
    scene: Scene,
    camera: _Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> GBuffer:
    """The deep frame buffer of a scene: what each pixel's centre shows, not antialiased.

    Base colour is texture x factor x vertex colour in linear light. `ambient` is the base
    colour, `diffuse` base * (1 - metallic), `specular` the mix of 0.04 and base by metallic.
    The shader is Lambert where a surface is rough and no metal, Blinn elsewhere. Normals are
    bent by the material's normal map and face the camera, whichever side of a face is seen.

    **Arguments:**

    - `scene`: from `load`, `from_trimesh` or `still_life`.
    - `camera`: a `PinholeCamera`, with any intrinsics, or an `OrthographicCamera`.
    - `height`, `width`: image size in pixels.
    - `backend`: "opengl" rasterises; "embree" casts rays; "auto" takes OpenGL where it works
      and else Embree, and tells the logger `jaxfx.scene` which.
    - `layer_index`: 0 is what the camera sees; 1 the next surface behind it that shows its
      front (its corners counter-clockwise), and so on. Surfaces closer together than some
      1e-5 of their depth and of the scene's size may count as one.

    **Returns:** a `GBuffer` of float32. Pixels that show nothing have depth inf, shader -1 and
    zeros.

    **Raises:** `ValueError` for arguments out of range, and where layer 0 shows nothing at
    all; `RuntimeError` where the backend does not work on this machine.

    **Gradient:** none, with respect to the camera or anything else: this runs on the host,
    outside every transform.
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
    camera: _Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Float[Array, "height width"]:
    """The depth along the optical axis of what each pixel's centre shows: a shadow map, say.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, float32, scene units; inf where there is nothing.

    **Raises:** as `gbuffer`, but for a camera that sees nothing: all is inf then.

    **Gradient:** none: this runs on the host, outside every transform.
    """
    _, hits, size = _visible("depth", scene, camera, height, width, backend, layer_index)
    return jnp.asarray(depth_image(hits, *size))


def object_ids(
    scene: Scene,
    camera: _Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Int[Array, "height width"]:
    """Which object each pixel's centre shows, as an index into `scene.names`.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, int32; -1 where there is nothing.

    **Raises:** as `depth`.

    **Gradient:** none: these are integers.
    """
    _, hits, size = _visible("object_ids", scene, camera, height, width, backend, layer_index)
    return _ids(hits, scene.face_objects, size)


def material_ids(
    scene: Scene,
    camera: _Camera,
    *,
    height: int,
    width: int,
    backend: str = "auto",
    layer_index: int = 0,
) -> Int[Array, "height width"]:
    """Which material each pixel's centre shows, as an index into `scene.materials`.

    **Arguments:** as in `gbuffer`.

    **Returns:** height width, int32; -1 where there is nothing.

    **Raises:** as `depth`.

    **Gradient:** none: these are integers.
    """
    _, hits, size = _visible("material_ids", scene, camera, height, width, backend, layer_index)
    return _ids(hits, scene.face_materials, size)


def _ids(
    hits: Hits, of_face: Int[np.ndarray, " face"], size: tuple[int, int]
) -> Int[Array, "height width"]:
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
    """The camera, what it sees of layer `layer_index`, and the picture's size."""
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


def _warn_of_rounding(scene: Scene, camera: _Camera, caller: str) -> None:
    """Say where a camera's numbers have not kept its place to a thousandth of the scene."""
    pose = np.asarray(camera.world_from_camera)
    rounding = float(np.spacing(np.abs(pose[:3, 3]).max())) / 2
    if rounding > _COARSE * scene.radius:
        _logger.warning(
            "scene.%s(camera): the camera's place is rounded to %.2g in %s, where the scene is "
            "%.2g in size: move both to the origin, or set jax_enable_x64",
            caller,
            rounding,
            pose.dtype,
            2 * scene.radius,
        )


def _next_faces(
    first_faces: _FirstFaces, scene: Scene, view: View, hits: Hits, shape: tuple[int, int]
) -> Int[np.ndarray, "height width"]:
    """The next faces behind `hits` that show their front.

    A ray that meets a back goes on from there. One that does not get past where it started,
    for rounding, starts farther on each time.
    """
    found = np.full(shape, -1, np.int32)
    gap = np.full(shape, _GAP)
    behind = np.full(shape, np.inf)
    behind.flat[hits.pixel] = hits.depth
    while np.isfinite(behind).any():
        start = behind + gap * (behind + scene.radius)
        met = intersect(scene, view, first_faces(scene, view, start))
        passed = met.depth > start.flat[met.pixel]
        done = passed & met.front
        found.flat[met.pixel[done]] = met.face[done]
        gap.flat[met.pixel[~passed]] *= 2
        behind = np.full(shape, np.inf)
        behind.flat[met.pixel[~done]] = np.maximum(met.depth, start.flat[met.pixel])[~done]
    return found


def _backend(caller: str, name: str) -> _FirstFaces:
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
    """OpenGL where it works, else Embree; said once."""
    problems = {}
    for name, module in _BACKENDS.items():
        problems[name] = module.problem()
        if problems[name] is None:
            refused = "".join(f" ({key}: {why})" for key, why in problems.items() if why)
            _logger.info("scenes are rendered with %s%s", name, refused)
            return name
    reasons = "; ".join(f"{name}: {why}" for name, why in problems.items())
    raise RuntimeError(f"no backend of `jaxfx.scene` works on this machine: {reasons}.")
