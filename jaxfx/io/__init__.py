"""Images in files: colour into linear light, depth as the numbers that a file stores.

The file boundary, on the host: NumPy in and out. The sRGB curve exists only here. Layers of
OpenEXR files are `jaxfx.exr`'s.
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
