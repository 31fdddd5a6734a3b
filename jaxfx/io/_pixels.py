"""The numbers that a picture file stores, before any curve."""

import io
from typing import Any

import numpy as np


def png_values(data: bytes) -> np.ndarray:
    """The numbers of a PNG file, height width channel, over their largest."""
    from PIL import Image

    def pixels(layout: str = "") -> np.ndarray:
        picture: Any = Image.open(io.BytesIO(data), formats=("PNG",))
        if layout:
            picture.tile = [(*picture.tile[0][:3], layout)]
        palette = "RGBA" if "transparency" in picture.info else "RGB"
        mode = {"1": "L", "P": palette}.get(picture.mode, picture.mode)
        array = np.asarray(picture.convert(mode), np.float64)
        return array.reshape(*array.shape[:2], -1)

    # Of 16-bit colours Pillow keeps the high bytes. It gives the low ones when asked for the
    # other byte order, and both of grey and alpha as the four channels of RGBA.
    layout = Image.open(io.BytesIO(data), formats=("PNG",)).tile[0][3]
    if layout == "LA;16B":
        high_low = pixels("RGBA")
        return (256 * high_low[:, :, ::2] + high_low[:, :, 1::2]) / 65535
    if layout in ("RGB;16B", "RGBA;16B"):
        return (256 * pixels() + pixels(layout[:-1] + "L")) / 65535
    return pixels() / (65535 if layout == "I;16B" else 255)


def jpeg_values(data: bytes) -> np.ndarray:
    """The numbers of a JPEG file as RGB, height width 3, over their largest."""
    from PIL import Image

    picture = Image.open(io.BytesIO(data), formats=("JPEG",))
    return np.asarray(picture.convert("RGB"), np.float64) / 255
