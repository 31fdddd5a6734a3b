"""Image files: colour in linear light, depth as the numbers that a file stores.

| I want | call |
|---|---|
| an image from PNG, JPEG, EXR or Radiance (`.hdr`) | `read_color` |
| a depth or disparity from PNG, EXR, PFM, NPY or NPZ | `read_depth`, then `jaxfx.depth` |
| an 8-bit PNG to look at | `write_png` |
| PNG alone | `read_png` |
| to show linear light with another library | `srgb_from_linear` |
| linear light from 8-bit numbers in memory | `linear_from_srgb` |
| full range, several layers, or a G-buffer with its camera | `jaxfx.exr` |

This runs on the host: NumPy arrays in and out.
"""

from jaxfx.io.color import read_color
from jaxfx.io.depth import read_depth
from jaxfx.io.png import read_png, write_png
from jaxfx.io.srgb import linear_from_srgb, srgb_from_linear


__all__ = [
    "linear_from_srgb",
    "read_color",
    "read_depth",
    "read_png",
    "srgb_from_linear",
    "write_png",
]
