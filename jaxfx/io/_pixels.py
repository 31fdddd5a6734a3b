"""The numbers that a picture file stores, before any curve."""

import io
import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxfx._extras import needs
from jaxfx._files import StrPath


# How a colour profile names sRGB, in its two versions.
_SRGB = (b"sRGB", "sRGB".encode("utf-16-be"))


def png_values(data: bytes) -> np.ndarray:
    """The numbers of a PNG file, height width channel, over their largest."""
    with needs("io"):
        from PIL import Image

    def pixels(layout: str = "") -> np.ndarray:
        picture: Any = Image.open(io.BytesIO(data), formats=("PNG",))
        if layout:
            picture.tile = [(*picture.tile[0][:3], layout)]
        palette = "RGBA" if "transparency" in picture.info else "RGB"
        mode = {"1": "L", "P": palette}.get(picture.mode, picture.mode)
        array = np.asarray(picture.convert(mode) if mode != picture.mode else picture)
        return array.reshape(*array.shape[:2], -1).astype(np.float64)

    # Of 16-bit colours Pillow keeps the high bytes. It gives the low ones when asked for the
    # other byte order, and both of grey and alpha as the four channels of RGBA.
    header = Image.open(io.BytesIO(data), formats=("PNG",))
    layout = str(header.tile[0][3])
    largest = 65535 if "16" in layout else 255
    if layout == "LA;16B":
        high_low = pixels("RGBA")
        codes = 256 * high_low[:, :, ::2] + high_low[:, :, 1::2]
    elif layout in ("RGB;16B", "RGBA;16B"):
        codes = 256 * pixels() + pixels(layout[:-1] + "L")
    else:
        codes = pixels()
    # One colour of a file without alpha may be transparent. Greys of 2 and 4 bits are spread
    # over 8, and the colour is not.
    key = header.info.get("transparency")
    if key is not None and header.mode != "P":
        key = np.atleast_1d(key) * {"L;2": 85, "L;4": 17}.get(layout, 1)
        is_opaque = np.any(codes != key, axis=2, keepdims=True)
        codes = np.concatenate([codes, largest * is_opaque], axis=2)
    return codes / largest


def jpeg_values(data: bytes) -> np.ndarray:
    """The numbers of a JPEG file, height width channel (1 or 3), over their largest.

    As stored: where the file says how to turn it upright, that is left to the caller.
    """
    with needs("io"):
        from PIL import Image

    picture = Image.open(io.BytesIO(data), formats=("JPEG",))
    if picture.mode not in ("L", "RGB"):
        raise ValueError(f"`mode` must be grey or RGB, got {picture.mode}.")
    array = np.asarray(picture, np.float64)
    return array.reshape(*array.shape[:2], -1) / 255


def log_profile(path: StrPath, facts: Mapping[Any, Any]) -> None:
    """Say that a colour profile is not heeded, where it is another than sRGB."""
    profile = facts.get("icc_profile") or b""
    if profile and not any(name in profile for name in _SRGB):
        logging.getLogger("jaxfx").warning(
            "`%s` has a colour profile that is not heeded: its numbers are taken for sRGB.",
            path,
        )
