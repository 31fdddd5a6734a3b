"""Images from PNG, JPEG, EXR and Radiance files, in linear light.

`jaxfx.scene` uses `jpeg_values`.
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfx import exr
from jaxfx._extras import needs
from jaxfx._files import StrPath
from jaxfx.exr.rgbd import choose_image, images_of
from jaxfx.io.png import decode_png
from jaxfx.io.radiance import SIGNATURES, decode_radiance
from jaxfx.io.srgb import linear_from_srgb, log_profile


# The first bytes of each format.
PNG, JPEG, EXR = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"v/1\x01"

# How a photograph is turned upright, by its orientation in Exif data (1 is upright): whether
# rows and columns are swapped; the steps, 1 or -1, in which each is then read.
_UPRIGHT = {
    2: (False, 1, -1),
    3: (False, -1, -1),
    4: (False, -1, 1),
    5: (True, 1, 1),
    6: (True, 1, -1),
    7: (True, -1, -1),
    8: (True, -1, 1),
}
# Exif's tag for the orientation.
_ORIENTATION = 0x0112


def read_color(
    path: StrPath, *, layer: str | None = None
) -> Float[np.ndarray, "height width channel"]:
    """Read an image from a PNG, JPEG, EXR or Radiance (`.hdr`) file into linear light.

    The format is recognised by the file's first bytes, whatever its suffix.

    **Arguments:**

    - `path`: the file. PNG is read as by `read_png`; JPEG is taken for sRGB, and turned upright
      by its Exif data; EXR and Radiance are linear.
    - `layer`: the layer of an EXR file whose image is read, as for `exr.read_rgbd`. None takes
      the main image, or the only one.

    **Returns:** float32, height width channel, with the file's channels: 1 to 4.

    **Raises:** `ValueError` that names the file where it is damaged, in none of these formats,
    or has several images to choose from; `OSError` where it can't be opened.

    **Gradient:** none; the host side.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import io
    >>> io.write_png("image.png", np.zeros((6, 8, 3)))
    >>> io.read_color("image.png").shape
    (6, 8, 3)
    """
    data = Path(path).read_bytes()
    if data.startswith(EXR):
        layers = exr.read(path)
        images, named = images_of(layers)
        return layers[images[choose_image(path, images, named, layer)]].astype(np.float32)
    if layer is not None:
        raise ValueError(f"`{path}` must be an EXR file to have a layer `{layer}`.")
    if data.startswith(PNG):
        return decode_png(path, data)
    if data.startswith(JPEG):
        return _decode_jpeg(path, data)
    if data.startswith(SIGNATURES):
        return decode_radiance(path, data)
    got = f"one that begins with {data[:4]!r}" if data else "an empty one"
    raise ValueError(f"`{path}` must be a PNG, JPEG, EXR or Radiance file, got {got}.")


def _decode_jpeg(path: StrPath, data: bytes) -> np.ndarray:
    """The bytes of a JPEG file as an upright image in linear light; `path` is for errors."""
    with needs("io"):
        from PIL import Image

    try:
        values = jpeg_values(data)
        image = Image.open(BytesIO(data), formats=("JPEG",))
        orientation = image.getexif().get(_ORIENTATION, 1)
    except Exception as error:
        raise ValueError(
            f"`{path}` is damaged or not a JPEG of grey or RGB: {error}"
        ) from error
    log_profile(path, image.info)
    is_transposed, row_step, column_step = _UPRIGHT.get(orientation, (False, 1, 1))
    upright = (values.swapaxes(0, 1) if is_transposed else values)[::row_step, ::column_step]
    return linear_from_srgb(upright).astype(np.float32)


def jpeg_values(data: bytes) -> np.ndarray:
    """The codes of a JPEG file divided by 255, height width channel (1 or 3).

    The Exif orientation is not applied.
    """
    with needs("io"):
        from PIL import Image

    image = Image.open(BytesIO(data), formats=("JPEG",))
    if image.mode not in ("L", "RGB"):
        raise ValueError(f"`mode` must be grey or RGB, got {image.mode}.")
    array = np.asarray(image, np.float64)
    return array.reshape(*array.shape[:2], -1) / 255
