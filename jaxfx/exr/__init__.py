"""Images, their depth and deep frame buffers in OpenEXR files.

| I want | call |
|---|---|
| to write an image, or several arrays by name | `write` |
| to read every layer of a file | `read` |
| an image and its depth, from Blender's or another renderer's file | `read_rgbd` |
| to keep a G-buffer with its camera, and get both back | `write_gbuffer`, `read_gbuffer` |
| one image or one depth from a file of any format | `io.read_color`, `io.read_depth` |

This runs on the host: NumPy arrays in and out. An EXR file stores linear numbers, to the bit.

Blender and Nuke recognise a channel by the last letter of its name. `write` chooses the letters
by an array's shape and key:

| array               | key                    | channels in the file      |
|---------------------|------------------------|---------------------------|
| height width 3 or 4 | `""`, the main image   | `R` `G` `B` (`A`)         |
| height width 3 or 4 | `name`                 | `name.R` `.G` `.B` (`.A`) |
| height width 3 or 4 | a vector, see below    | `name.X` `.Y` `.Z` (`.W`) |
| height width 2      | `name`                 | `name.X` `.Y`             |
| height width 1      | `""` or `name`         | `Y`, `name.Y`             |
| height width        | `depth`                | `depth.Z`                 |
| height width        | `name`                 | `name.V`                  |

A vector's key is `normal`, `position`, `direction`, `tangent`, `velocity`, `motion` or
`vector`, in any letter case, alone or after a dot: `left.Normal`.

| numbers                 | stored as                                                     |
|-------------------------|---------------------------------------------------------------|
| float16, float32        | HALF, FLOAT, to the bit, infinities and NaNs included         |
| float64                 | FLOAT, rounded: EXR has no double                             |
| bool, unsigned integers | UINT; read as uint32                                          |
| signed integers         | FLOAT, exact or refused: EXR has none; read as float32        |
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
