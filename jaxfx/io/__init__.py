"""Pictures in files for screens: PNG, sRGB on disk and linear in memory.

The file boundary, on the host: NumPy in and out. The sRGB curve exists only here. OpenEXR files
are `jaxfx.exr`'s.
"""

from jaxfx.io.png import linear_from_srgb, read_png, srgb_from_linear, write_png


__all__ = ["linear_from_srgb", "read_png", "srgb_from_linear", "write_png"]
