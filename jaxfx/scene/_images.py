"""Images that mesh files name or hold, as textures."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from jaxfx._extras import MissingExtraError, needs
from jaxfx.io.color import jpeg_values
from jaxfx.io.png import png_values
from jaxfx.scene._part import UnreadableError


_Texture = UInt8[np.ndarray, "height width 3"] | UInt16[np.ndarray, "height width 3"]
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_OTHERS = {b"BM": "BMP", b"II*\0": "TIFF", b"MM\0*": "TIFF", b"RIFF": "WEBP", b"GIF8": "GIF"}


def find_file(folder: Path, *names: str) -> Path:
    """The file that a mesh file calls by one of `names`, relative to `folder`.

    Where there is none, a backslash parts folders too, and then capitals do not count: so the
    file is found as on the system that it was written on.
    """
    for name in names:
        for spelled in (name, name.replace("\\", "/")):
            if spelled and (folder / spelled).is_file():
                return folder / spelled
    for name in names:
        found = list(_in_any_case(folder, name.replace("\\", "/")))
        if len(found) == 1:
            return found[0]
        if found:
            same = " and ".join(repr(str(path)) for path in found[:2])
            raise UnreadableError(f"{name!r} is the name of {same}")
    raise UnreadableError(f"there is no file {names[0]!r} in {str(folder)!r}")


def _in_any_case(folder: Path, name: str) -> Iterator[Path]:
    places = [folder]
    for part in Path(name).parts:
        if part in (".", "..", "/"):
            places = [place / part for place in places]
        else:
            places = [
                inside
                for place in places
                if place.is_dir()
                for inside in place.iterdir()
                if inside.name.casefold() == part.casefold()
            ]
    return (place for place in places if place.is_file())


def read_image(data: bytes, name: str) -> _Texture:
    """The colours of an image file, without alpha, in the file's own 8 or 16 bits."""
    try:
        return _colors(data, name)
    except UnreadableError:
        raise
    except MissingExtraError:
        raise
    except Exception as error:
        raise UnreadableError(f"the image {name!r} can't be read: {error}") from error


def _colors(data: bytes, name: str) -> _Texture:
    if data.startswith(_PNG):
        values = png_values(data)
        dtype = np.dtype(np.uint16 if data[24] == 16 else np.uint8)
    elif data.startswith(_JPEG):
        values, dtype = jpeg_values(data), np.dtype(np.uint8)
    else:
        return _by_pillow(data, name)
    codes = np.rint(values * np.iinfo(dtype).max).astype(dtype)
    return _three(codes)


def _three(codes: np.ndarray) -> _Texture:
    """RGB of grey, grey and alpha, RGB or RGBA."""
    if codes.shape[2] < 3:
        codes = np.repeat(codes[:, :, :1], 3, axis=2)
    return np.ascontiguousarray(codes[:, :, :3])


def _by_pillow(data: bytes, name: str) -> _Texture:
    with needs("scene"):
        from PIL import Image

    kinds = [kind for start, kind in _OTHERS.items() if data.startswith(start)]
    if not kinds and name.lower().endswith(".tga"):  # TGA files have no sign of their own
        kinds = ["TGA"]
    if not kinds:
        raise UnreadableError(
            f"the image {name!r} is neither PNG, JPEG, BMP, TGA, TIFF nor WebP"
        )
    with Image.open(io.BytesIO(data), formats=kinds) as image:
        return pillow_codes(image, name)


def pillow_codes(image: Any, name: str) -> _Texture:
    """The colours of an image of Pillow's, in 8 bits or, of 16-bit grey, in 16."""
    is_wide_png = image.mode == "I" and image.format == "PNG"
    if image.mode.startswith("I;16") or is_wide_png:
        return _three(np.asarray(image).astype(np.uint16)[:, :, None])
    if image.mode in ("I", "F"):
        raise UnreadableError(f"the image {name!r} has neither 8 nor 16 bits a channel")
    return np.asarray(image.convert("RGBA").convert("RGB"))
