"""Visible faces and unobstructed segments by ray casting, with Embree.

The benchmarks cast shadow rays of their own by `accelerated`.
"""

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


# How far right of and below a pixel's centre its ray passes, in pixels: half a step of the grid
# to which rasterisers snap corners. With 0, rays at the middle of an edge slip through.
_RAY_OFFSET = 1 / 512
# How far a segment between two points is shortened at each end, relative to the scene's radius.
# With less, the surface that a point lies on hides it by rounding; with more, light leaks
# through thin walls and contacts.
_INSET = 1e-4
_built: weakref.WeakKeyDictionary[Scene, Any] = weakref.WeakKeyDictionary()


def first_faces(
    scene: Scene,
    view: View,
    start: Float[np.ndarray, "height width"],
) -> Int[np.ndarray, "height width"]:
    """The first face beyond the depth `start` along each pixel's ray; -1 where there is none.

    Rays pass `_RAY_OFFSET` beside the pixel's centre. So they seldom meet an edge or vertex
    exactly, where even Embree's robust test misses one in a hundred, and a centre on an edge
    gets the face that a rasteriser would give it.
    """
    offset = np.zeros((3, 3))
    offset[:2, 2] = _RAY_OFFSET
    view = view._replace(intrinsics=view.intrinsics - offset)
    pixel = np.flatnonzero(np.isfinite(start))
    origins, directions = (rays.take(pixel, axis=1) for rays in view.rays(*start.shape))
    world = view.to_world(origins + start.take(pixel) * directions)
    unit = (world - scene.center[:, None]) / scene.radius
    faces = np.full(start.shape, -1, np.int32)
    faces.flat[pixel] = accelerated(scene).run(
        np.ascontiguousarray(unit.T, np.float32),
        np.ascontiguousarray(view.turn(directions).T, np.float32),
    )
    return faces


def first_along(
    scene: Scene,
    start: Float[np.ndarray, "ray 3"],
    direction: Float[np.ndarray, "ray 3"],
) -> Int[np.ndarray, " ray"]:
    """The first face along rays of unit directions that may begin on surfaces; -1 for none."""
    start = (start - scene.center) / scene.radius + _INSET * direction
    return accelerated(scene).run(
        np.ascontiguousarray(start, np.float32), np.ascontiguousarray(direction, np.float32)
    )


def unobstructed(
    scene: Scene,
    start: Float[np.ndarray, "ray 3"],
    end: Float[np.ndarray, "ray 3"],
) -> Bool[np.ndarray, " ray"]:
    """Whether no face lies between two points, which may themselves lie on surfaces."""
    start, end = ((points - scene.center) / scene.radius for points in (start, end))
    segment = end - start
    length = np.linalg.norm(segment, axis=1, keepdims=True)
    inset = np.minimum(_INSET, length / 4) * segment / np.where(length > 0, length, 1)
    hits = accelerated(scene).run(
        np.ascontiguousarray(start + inset, np.float32),
        np.ascontiguousarray(segment - 2 * inset, np.float32),
        dists=np.ones(len(segment), np.float32),
        query="OCCLUDED",
    )
    return hits < 0


def accelerated(scene: Scene) -> Any:
    """The scene's triangles in Embree's acceleration structure; `run` casts rays.

    Coordinates are those of `Scene.unit_triangles`. It is built once per scene.
    """
    if scene not in _built:
        with needs("scene"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

        robust = EmbreeScene(robust=True)
        TriangleMesh(robust, scene.unit_triangles)
        _built[scene] = robust
    return _built[scene]
