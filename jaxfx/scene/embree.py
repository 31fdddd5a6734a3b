"""Visibility by ray casting, with Embree."""

import importlib
import weakref
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfx._extras import needs
from jaxfx.scene._scene import Scene
from jaxfx.scene._view import View


@cache
def problem() -> str | None:
    """Why Embree can't be used here, or None where it can."""
    try:
        importlib.import_module("embreex.rtcore_scene")
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


_NUDGE = 1 / 512  # pixels; a rasteriser's own grid is some 1/256
_INSET = 1e-4  # of the scene's radius, off the surfaces that a way begins and ends on
_built: weakref.WeakKeyDictionary[Scene, Any] = weakref.WeakKeyDictionary()


def first_faces(
    scene: Scene,
    view: View,
    start: Float[np.ndarray, "height width"],
) -> Int[np.ndarray, "height width"]:
    """The first face past the depth `start` along each pixel's ray; -1 where there is none.

    Rays pass `_NUDGE` right of and below the pixel's centre. So they seldom meet an edge or a
    vertex in the middle, where even Embree's robust test lets one in a hundred through, and a
    centre on an edge goes to the face that a rasteriser would give it to.
    """
    aside = np.zeros((3, 3))
    aside[:2, 2] = _NUDGE
    view = view._replace(intrinsics=view.intrinsics - aside)
    pixel = np.flatnonzero(np.isfinite(start))
    origins, directions = (each.take(pixel, axis=1) for each in view.rays(*start.shape))
    begin = view.to_world(origins + start.take(pixel) * directions)
    unit = (begin - scene.center[:, None]) / scene.radius
    faces = np.full(start.shape, -1, np.int32)
    faces.flat[pixel] = accelerated(scene).run(
        np.ascontiguousarray(unit.T, np.float32),
        np.ascontiguousarray(view.turn(directions).T, np.float32),
    )
    return faces


def unobstructed(
    scene: Scene,
    start: Float[np.ndarray, "ray 3"],
    end: Float[np.ndarray, "ray 3"],
) -> Bool[np.ndarray, " ray"]:
    """Whether nothing stands between the ends, which may lie on surfaces themselves."""
    start, end = ((each - scene.center) / scene.radius for each in (start, end))
    way = end - start
    length = np.linalg.norm(way, axis=1, keepdims=True)
    inset = np.minimum(_INSET, length / 4) * way / np.where(length > 0, length, 1)
    hits = accelerated(scene).run(
        np.ascontiguousarray(start + inset, np.float32),
        np.ascontiguousarray(way - 2 * inset, np.float32),
        dists=np.ones(len(way), np.float32),
        query="OCCLUDED",
    )
    return hits < 0


def accelerated(scene: Scene) -> Any:
    """The scene's triangles in Embree's tree, built once per scene: `.run` casts rays.

    Coordinates are those of `Scene.unit_triangles`.
    """
    if scene not in _built:
        with needs("scene"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

        robust = EmbreeScene(robust=True)
        TriangleMesh(robust, scene.unit_triangles)
        _built[scene] = robust
    return _built[scene]
