"""G-buffers with their cameras in EXR files."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxfx._files import StrPath, check_suffix
from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.exr._parts import MAX_PIXELS
from jaxfx.exr.layers import assemble, read_planes, write_planes
from jaxfx.gbuffer import GBuffer


# The fields of `GBuffer`, each a layer of the file.
_PASSES = ("color", "shader", "ambient", "diffuse", "specular", "normal", "depth", "roughness")


class Cache(NamedTuple):
    """A G-buffer and its camera: what `read_gbuffer` returns.

    - `gbuffer`: the `GBuffer`.
    - `camera`: the `PinholeCamera` or `OrthographicCamera`, or None where the file has none.
    """

    gbuffer: GBuffer
    camera: Camera | None


def write_gbuffer(path: StrPath, gbuffer: GBuffer, *, camera: Camera | None = None) -> None:
    """Write a deep frame buffer as eight layers of one EXR file, with its camera.

    `read_gbuffer` reads both back.

    **Arguments:**

    - `path`: the file, written whole or not at all.
    - `gbuffer`: float16 and float32 are kept, float64 is rounded; shaders are stored as
      floats, exactly.
    - `camera`: stored exactly in the header: its kind, the 3x3 matrix from camera axes to
      pixels, and the 4x4 pose. None stores no camera.

    **Raises:** `ValueError` and `OSError`, as `write`.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import exr, scene
    >>> mesh = scene.still_life()
    >>> camera = scene.default_camera(mesh, height=6, width=8)
    >>> gbuffer = scene.gbuffer(mesh, camera, height=6, width=8)
    >>> exr.write_gbuffer("cache.exr", gbuffer, camera=camera)
    >>> sorted(exr.read("cache.exr"))[:4]
    ['ambient', 'color', 'depth', 'diffuse']
    """
    check_suffix("write_gbuffer(path)", path, ".exr")
    attributes: dict[str, Any] = {}
    if camera is not None:
        attributes = {
            "jaxfx.camera": type(camera).__name__,
            "jaxfx.intrinsics": _matrix(_intrinsics(camera)),
            "jaxfx.world_from_camera": _matrix(np.asarray(camera.world_from_camera)),
        }
    write_planes(path, {name: getattr(gbuffer, name) for name in _PASSES}, attributes)


def read_gbuffer(path: StrPath, *, max_pixels: int = MAX_PIXELS, verify: bool = True) -> Cache:
    """Read a deep frame buffer and its camera that `write_gbuffer` wrote.

    Other layers in the file are ignored.

    **Arguments:** `path`, `max_pixels`, `verify`: as for `read`.

    **Returns:** a `Cache`: `gbuffer`, and `camera`, which is None where the file has none.

    **Raises:** `ValueError` and `OSError`, as `read`; a missing layer is named.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import exr, scene
    >>> mesh = scene.still_life()
    >>> view = scene.default_camera(mesh, height=6, width=8)
    >>> gbuffer = scene.gbuffer(mesh, view, height=6, width=8)
    >>> exr.write_gbuffer("cache.exr", gbuffer, camera=view)
    >>> gbuffer, camera = exr.read_gbuffer("cache.exr")
    >>> gbuffer.normal.shape, type(camera).__name__
    ((6, 8, 3), 'PinholeCamera')
    """
    planes, header = read_planes(path, max_pixels, verify)
    layers = assemble(path, planes)
    for name in _PASSES:
        if name not in layers:
            raise ValueError(f"`{path}` must have the layer `{name}`, got {sorted(layers)}.")
    passes = {name: layers[name] for name in _PASSES}
    with np.errstate(invalid="ignore"):
        shader = passes["shader"].astype(np.int32)
    if not np.array_equal(shader, passes["shader"]):
        raise ValueError(f"`{path}` must have whole numbers in the layer `shader`.")
    try:
        return Cache(GBuffer(**passes | {"shader": shader}), _camera(header))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"`{path}` must hold a deep frame buffer: {error}") from error


def _matrix(values: np.ndarray) -> np.ndarray:
    """A matrix in float32 or float64, the two types that EXR has for matrices."""
    dtype = np.float64 if values.dtype == np.float64 else np.float32
    return np.ascontiguousarray(values, dtype)


def _intrinsics(camera: Camera) -> np.ndarray:
    """The 3x3 matrix from camera axes to pixels, of either kind of camera."""
    if isinstance(camera, PinholeCamera):
        return np.asarray(camera.intrinsics)
    scale, center = np.asarray(camera.pixels_per_unit), np.asarray(camera.center)
    matrix = np.eye(3, dtype=np.result_type(scale, center))
    matrix[0, 0] = matrix[1, 1] = scale
    matrix[:2, 2] = center
    return matrix


def _camera(header: Mapping[str, Any]) -> Camera | None:
    """The camera in a header, or None; the inverse of `_intrinsics`."""
    kind = header.get("jaxfx.camera")
    if kind is None:
        return None
    intrinsics, pose = header["jaxfx.intrinsics"], header["jaxfx.world_from_camera"]
    if kind == PinholeCamera.__name__:
        return PinholeCamera(intrinsics, pose)
    if kind == OrthographicCamera.__name__:
        return OrthographicCamera(intrinsics[0, 0], intrinsics[:2, 2], pose)
    raise ValueError(f"`jaxfx.camera` must be one of the two cameras, got {kind!r}.")
