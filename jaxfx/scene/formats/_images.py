"""Image files that mesh files refer to or contain, as textures."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from jaxfx._extras import MissingExtraError, needs
from jaxfx.io.color import JPEG, PNG, jpeg_values
from jaxfx.io.png import png_values
from jaxfx.scene._part import UnreadableError


_Texture = UInt8[np.ndarray, "height width 3"] | UInt16[np.ndarray, "height width 3"]
# The first bytes of files that Pillow decodes.
_OTHERS = {b"BM": "BMP", b"II*\0": "TIFF", b"MM\0*": "TIFF", b"RIFF": "WEBP", b"GIF8": "GIF"}


def find_file(folder: Path, *names: str) -> Path:
    """The file that a mesh file refers to by one of `names`, relative to `folder`.

    If there is none, backslashes are read as separators, then letter case is ignored, as on
    Windows, where many mesh files are written.
    """
    for name in names:
        for spelled in (name, name.replace("\\", "/")):
            if spelled and (folder / spelled).is_file():
                return folder / spelled
    for name in names:
        paths = list(_in_any_case(folder, name.replace("\\", "/")))
        if len(paths) == 1:
            return paths[0]
        if paths:
            first_two = " and ".join(repr(str(path)) for path in paths[:2])
            raise UnreadableError(f"{name!r} is the name of {first_two}")
    raise UnreadableError(f"there is no file {names[0]!r} in {str(folder)!r}")


def _in_any_case(folder: Path, name: str) -> Iterator[Path]:
    """The files called `name` in `folder`, letter case ignored in every part of the path."""
    paths = [folder]
    for part in Path(name).parts:
        if part in (".", "..", "/"):
            paths = [path / part for path in paths]
        else:
            paths = [
                entry
                for path in paths
                if path.is_dir()
                for entry in path.iterdir()
                if entry.name.casefold() == part.casefold()
            ]
    return (path for path in paths if path.is_file())


def read_image(data: bytes, name: str) -> _Texture:
    """The colours of an image file, without alpha, in 8 or 16 bits as in the file.

    `name` stands for the image in errors.
    """
    try:
        return _colors(data, name)
    except (UnreadableError, MissingExtraError):
        raise
    except Exception as error:
        raise UnreadableError(f"the image {name!r} can't be read: {error}") from error


def _colors(data: bytes, name: str) -> _Texture:
    """As `read_image`, with whatever error the decoder raises."""
    if data.startswith(PNG):
        values = png_values(data)
        dtype = np.dtype(np.uint16 if data[24] == 16 else np.uint8)
    elif data.startswith(JPEG):
        values, dtype = jpeg_values(data), np.dtype(np.uint8)
    else:
        return _decode_with_pillow(data, name)
    codes = np.rint(values * np.iinfo(dtype).max).astype(dtype)
    return _rgb(codes)


def _rgb(codes: np.ndarray) -> _Texture:
    """The RGB channels of grey, grey and alpha, RGB or RGBA."""
    if codes.shape[2] < 3:
        codes = np.repeat(codes[:, :, :1], 3, axis=2)
    return np.ascontiguousarray(codes[:, :, :3])


def _decode_with_pillow(data: bytes, name: str) -> _Texture:
    """The colours of a BMP, TIFF, WebP, GIF or TGA file."""
    with needs("scene"):
        from PIL import Image

    kinds = [kind for start, kind in _OTHERS.items() if data.startswith(start)]
    if not kinds and name.lower().endswith(".tga"):  # TGA files do not begin with fixed bytes.
        kinds = ["TGA"]
    if not kinds:
        raise UnreadableError(
            f"the image {name!r} is neither PNG, JPEG, BMP, TGA, TIFF nor WebP"
        )
    with Image.open(io.BytesIO(data), formats=kinds) as image:
        return pillow_codes(image, name)


def pillow_codes(image: Any, name: str) -> _Texture:
    """The RGB codes of a Pillow image: uint8, or uint16 where it is 16-bit grey."""
    is_wide_png = image.mode == "I" and image.format == "PNG"
    if image.mode.startswith("I;16") or is_wide_png:
        return _rgb(np.asarray(image).astype(np.uint16)[:, :, None])
    if image.mode in ("I", "F"):
        raise UnreadableError(f"the image {name!r} has neither 8 nor 16 bits a channel")
    return np.asarray(image.convert("RGBA").convert("RGB"))
