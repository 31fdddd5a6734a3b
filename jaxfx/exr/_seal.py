"""The checksum that `write` puts into a file's header, since EXR itself has none."""

import zlib

from jaxfx._files import StrPath


# Two attributes of our own, so that no damage to a single byte makes a file look foreign; and
# the first one as it stands in a file, before the four bytes of its value.
CHECKSUM, VERSION = "jaxfx.crc32", "jaxfx.version"
_MARK = CHECKSUM.encode() + b"\0int\0" + (4).to_bytes(4, "little")


def seal(data: bytearray) -> None:
    """Put the checksum into a file whose header has `CHECKSUM` as a 0."""
    at = _value(data)
    data[at : at + 4] = _checksum(data, at).to_bytes(4, "little")


def verify(path: StrPath, data: bytes) -> None:
    """Raise `ValueError` if `data` is a file of our own that has changed since."""
    if CHECKSUM.encode() not in data and VERSION.encode() not in data:
        return
    at = _value(data)
    if at < 0 or data[at : at + 4] != _checksum(data, at).to_bytes(4, "little"):
        raise ValueError(
            f"`{path}` is damaged: its checksum does not fit. If another program has rewritten "
            "it, `verify=False` reads it."
        )


def _value(data: bytes | bytearray) -> int:
    """Where the checksum stands in a file; -1 where it has none."""
    start = data.find(_MARK)
    return start if start < 0 else start + len(_MARK)


def _checksum(data: bytes | bytearray, at: int) -> int:
    """CRC-32 of a file, the four bytes of the checksum itself as zeros."""
    view = memoryview(data)
    return zlib.crc32(view[at + 4 :], zlib.crc32(bytes(4), zlib.crc32(view[:at])))
