"""Images, their depth and deep frame buffers in OpenEXR files.

The file boundary, on the host: NumPy in and out. An EXR file holds linear numbers and keeps
them to the bit; `jaxfx.io` has the formats for screens.

Blender and Nuke know a channel by the last letter of its name, so the shape of an array and
its key choose the letters:

| array               | key                    | channels in the file      |
|---------------------|------------------------|---------------------------|
| height width 3 or 4 | `""`, the main picture | `R` `G` `B` (`A`)         |
| height width 3 or 4 | `name`                 | `name.R` `.G` `.B` (`.A`) |
| height width 3 or 4 | a vector's, see below  | `name.X` `.Y` `.Z` (`.W`) |
| height width 2      | `name`                 | `name.X` `.Y`             |
| height width 1      | `""` or `name`         | `Y`, `name.Y`             |
| height width        | `depth`                | `depth.Z`                 |
| height width        | `name`                 | `name.V`                  |

Vectors are `normal`, `position`, `direction`, `tangent`, `velocity`, `motion` and `vector`, in
any case and after any dot: `left.Normal`.

| numbers                 | stored as                                                     |
|-------------------------|---------------------------------------------------------------|
| float16, float32        | HALF, FLOAT: every bit, infinities and NaNs too               |
| float64                 | FLOAT, rounded: EXR has no double                             |
| bool, unsigned integers | UINT; they come back as uint32                                |
| signed integers         | FLOAT, exact or refused: EXR has none; they come back float32 |
"""

from jaxfx.exr.frame import Cache, read_gbuffer, write_gbuffer
from jaxfx.exr.layers import read, write
from jaxfx.exr.rgbd import RGBD, read_rgbd


__all__ = [
    "RGBD",
    "Cache",
    "read",
    "read_gbuffer",
    "read_rgbd",
    "write",
    "write_gbuffer",
]
