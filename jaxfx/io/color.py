"""Images of colour from any file, by what is in it."""

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfx import exr
from jaxfx._extras import needs
from jaxfx._files import StrPath
from jaxfx.exr.rgbd import choose_image, images_of
from jaxfx.io.png import decode_png
from jaxfx.io.srgb import linear_from_srgb, log_profile


PNG, JPEG, EXR = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"v/1\x01"

# How a photograph is turned upright, by the orientation of its Exif data: whether rows and
# columns change places, and which of the two then run backwards.
_UPRIGHT = {
    2: (False, 1, -1),
    3: (False, -1, -1),
    4: (False, -1, 1),
    5: (True, 1, 1),
    6: (True, 1, -1),
    7: (True, -1, -1),
    8: (True, -1, 1),
}
_ORIENTATION = 0x0112


def read_color(
    path: StrPath, *, layer: str | None = None
) -> Float[np.ndarray, "height width channel"]:
    """Read an image into linear light: PNG, JPEG or EXR, whatever its name ends in.

    **Arguments:**

    - `path`: the file. PNG as by `read_png`; JPEG likewise, turned upright as its Exif data
      say; EXR is linear.
    - `layer`: of an EXR file with several layers the one whose image is wanted, as for
      `exr.read_rgbd`; without it the main image, or the only one.

    **Returns:** float32, height width channel, with the channels that the file has: 1 to 4.

    **Raises:** `ValueError` that names the file where it is damaged, or in none of these
    formats, or where its layers leave a choice; `OSError` where it can't be opened.

    **Gradient:** none; the host side.
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
    found = f"one that begins with {data[:4]!r}" if data else "an empty one"
    raise ValueError(f"`{path}` must be a PNG, JPEG or EXR file, got {found}.")


def _decode_jpeg(path: StrPath, data: bytes) -> np.ndarray:
    with needs("io"):
        from PIL import Image

    try:
        values = jpeg_values(data)
        picture = Image.open(BytesIO(data), formats=("JPEG",))
        turn = picture.getexif().get(_ORIENTATION, 1)
    except Exception as error:
        raise ValueError(
            f"`{path}` is damaged or not a JPEG of grey or RGB: {error}"
        ) from error
    log_profile(path, picture.info)
    is_turned, down, right = _UPRIGHT.get(turn, (False, 1, 1))
    upright = (values.swapaxes(0, 1) if is_turned else values)[::down, ::right]
    return linear_from_srgb(upright).astype(np.float32)


def jpeg_values(data: bytes) -> np.ndarray:
    """The numbers of a JPEG file, height width channel (1 or 3), over their largest.

    As stored: where the file says how to turn it upright, that is left to the caller.
    """
    with needs("io"):
        from PIL import Image

    picture = Image.open(BytesIO(data), formats=("JPEG",))
    if picture.mode not in ("L", "RGB"):
        raise ValueError(f"`mode` must be grey or RGB, got {picture.mode}.")
    array = np.asarray(picture, np.float64)
    return array.reshape(*array.shape[:2], -1) / 255
