"""Shadows: the visibility of a light per pixel, by comparing depths with a shadow map.

Make the cameras (`light_cameras`), render their depth (`jaxfx.scene.depth`, or any renderer),
find the `receivers`, filter; then hand the visibility to `jaxfx.relight`.

| I want | call |
|---|---|
| cameras to render shadow maps with | `light_cameras(light, map_size=...)` |
| what every filter takes | `receivers(depth, camera, light_camera)` |
| a preview | `hard(shadow_map, receivers)` |
| smooth edges of one width | `edge_pcf(shadow_map, receivers, size=...)` |
| edges that do not jump as things move | `edge_pcf(..., kernel="tent")` |
| edges that are wider away from the occluder | `pcss(..., light_camera, light_size=...)` |
| gradients | `edge_pcf(..., softness=...)`, `pcss(..., softness=...)` |
| a cost that does not grow with the filter | `variance(..., exponents=(80, 10))` |
| the quickest within an error | `jaxfx.budget.shadow(..., max_error=...)` |
| the pixels that `edge_pcf` filters | `candidates(shadow_map, receivers, size=...)` |

Kept for comparison: `pcf`, which filters every pixel, to the same result as `edge_pcf`;
`edge_pcf(edges="screen")`, the published search for edges in the image, which misses thin
shadows; `prefiltered`, which averages depths before it compares them, the wrong order;
`variance` without `exponents`, which leaks light where occluders overlap.
"""

from jaxfx.shadow.cameras import light_cameras
from jaxfx.shadow.edge import Candidates, candidates, edge_pcf
from jaxfx.shadow.moving_shadow import MovingShadow
from jaxfx.shadow.pcf import hard, pcf, prefiltered
from jaxfx.shadow.pcss import pcss
from jaxfx.shadow.receivers import Receivers, receivers
from jaxfx.shadow.variance import variance


__all__ = [
    "Candidates",
    "MovingShadow",
    "Receivers",
    "candidates",
    "edge_pcf",
    "hard",
    "light_cameras",
    "pcf",
    "pcss",
    "prefiltered",
    "receivers",
    "variance",
]
