"""Reprojection: images with depth, seen from other cameras.

| I want | call |
|---|---|
| an image from another camera | `warp(image, depth, camera, target)` |
| one from several, which fill each other's holes | `blend(images, depths, cameras, target)` |
| the few of many cameras worth blending | `choose(depths, cameras, target, count=...)` |
| the fewest rays within an error | `jaxfx.budget.reproject(..., max_error=...)` |
| a preview | `warp` or `blend` with a small `height=, width=` |
| gradients with respect to depth and poses | any of these; `jaxfx.fit.camera` fits a pose |
| the first crossing of own rays with a depth map | `intersect(depth, origin, direction)` |

`search="pyramid"`, the default everywhere, is exact. Kept for comparison: `search="descent"`,
the published descent, which passes occluders beside a ray's path; `"linear"` (parallax
occlusion) and `"relief"` (relief mapping), which step over thin objects.
"""

from jaxfx._choice import Choice
from jaxfx.reproject.blend import blend, choose
from jaxfx.reproject.intersect import Hit, intersect
from jaxfx.reproject.warp import warp


__all__ = ["Choice", "Hit", "blend", "choose", "intersect", "warp"]
