"""Radiance pictures (`.hdr`), the usual files of panoramas: three mantissas, one exponent."""

import re

import numpy as np

from jaxfx._files import StrPath


SIGNATURES = b"#?RADIANCE", b"#?RGBE"
# The line that ends the header: rows from the top (-Y), columns from the left (+X).
_SIZE = re.compile(rb"-Y +(\d+) +\+X +(\d+)")
# Widths of which a row may be coded channel by channel.
_CODED_WIDTHS = range(8, 0x8000)


def decode_radiance(path: StrPath, data: bytes) -> np.ndarray:
    """The bytes of a Radiance file as float32 radiance, height width 3; `path` is for errors.

    A channel is `(mantissa + 0.5) * 2**(exponent - 136)`, as Radiance's own reader has it
    (Ward, "Real Pixels", Graphics Gems II, 1991), divided by the header's exposures.
    """
    header, mark, body = data.partition(b"\n\n")
    size, newline, body = body.partition(b"\n")
    shape = _SIZE.fullmatch(size.strip())
    if not (mark and newline and b"FORMAT=32-bit_rle_rgbe" in header and shape):
        raise ValueError(
            f"`{path}` must be a Radiance picture of 32-bit_rle_rgbe whose size is `-Y height "
            f"+X width`, got the size {size[:40]!r}."
        )
    height, width = map(int, shape.groups())
    exposures = re.findall(rb"^EXPOSURE= *(\S+)", header, re.MULTILINE)
    try:
        texels = _texels(body, height, width)
        exposure = float(np.prod([float(number) for number in exposures]))
    except (EOFError, IndexError, ValueError) as error:
        raise ValueError(f"`{path}` is damaged: {error}") from error
    if height * width == 0 or not 0 < exposure < np.inf:
        raise ValueError(
            f"`{path}` must have pixels and a positive exposure, got {height} x {width} pixels "
            f"and {exposure}."
        )
    exponent = texels[..., 3:].astype(np.int32)
    values = np.ldexp(texels[..., :3] + 0.5, exponent - 136)
    return (np.where(exponent > 0, values, 0) / exposure).astype(np.float32)


def _texels(body: bytes, height: int, width: int) -> np.ndarray:
    """Mantissas and exponent of each pixel, height width 4, of rows that are coded or not."""
    marker = bytes([2, 2, width >> 8 & 255, width & 255])
    if width not in _CODED_WIDTHS or not body.startswith(marker):
        flat = np.frombuffer(body, np.uint8)
        if flat.size != 4 * height * width:
            raise EOFError(f"{flat.size} bytes for {height} x {width} pixels of 4 bytes")
        texels = flat.reshape(height, width, 4)
        # Pixels of 1, 1, 1 repeat the one before them, in files of the first version.
        if (texels[..., :3] == 1).all(axis=-1).any():
            raise EOFError("pixels are coded as in the first version, which is not read")
        return texels
    if len(body) < 4 * height:
        raise EOFError(f"{len(body)} bytes for {height} rows")
    channels, at = np.empty((height, 4, width), np.uint8), 0
    for row in channels:
        if body[at : at + 4] != marker:
            raise EOFError("a row does not begin with its width")
        at += 4
        for channel in row:
            at = _fill_channel(channel, body, at)
    return channels.transpose(0, 2, 1)


def _fill_channel(channel: np.ndarray, body: bytes, at: int) -> int:
    """Decode one channel of a row, from byte `at` on; returns where the next one begins."""
    done = 0
    while done < len(channel):
        count, at = body[at], at + 1
        is_run = count > 128
        count -= 128 * is_run
        stored = body[at : at + (1 if is_run else count)]
        if not 0 < count <= len(channel) - done or not stored:
            raise EOFError("a row ends early or is too long")
        channel[done : done + count] = np.frombuffer(stored, np.uint8)
        done, at = done + count, at + len(stored)
    return at
