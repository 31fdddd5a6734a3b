"""The checksum that `write` stores in a file's header, since EXR itself has none."""

import zlib

from jaxfx._files import StrPath


# The names of two header attributes. A file with either of them must have a checksum that fits:
# one damaged byte can't hide both. `_MARK` is the first attribute as bytes of the file, up to
# the four bytes of its value.
CHECKSUM, VERSION = "jaxfx.crc32", "jaxfx.version"
_MARK = CHECKSUM.encode() + b"\0int\0" + (4).to_bytes(4, "little")


def seal(data: bytearray) -> None:
    """Store the checksum in a file whose header has the attribute `CHECKSUM`."""
    at = _value_offset(data)
    data[at : at + 4] = _checksum(data, at).to_bytes(4, "little")


def verify(path: StrPath, data: bytes) -> None:
    """Raise `ValueError` if `data` was written by `seal` and has changed since."""
    if CHECKSUM.encode() not in data and VERSION.encode() not in data:
        return
    at = _value_offset(data)
    if at < 0 or data[at : at + 4] != _checksum(data, at).to_bytes(4, "little"):
        raise ValueError(
            f"`{path}` is damaged: its checksum does not fit. If another program has rewritten "
            "it, `verify=False` reads it."
        )


def _value_offset(data: bytes | bytearray) -> int:
    """The offset of the checksum's four bytes in a file; -1 where it has none."""
    start = data.find(_MARK)
    return start if start < 0 else start + len(_MARK)


def _checksum(data: bytes | bytearray, at: int) -> int:
    """CRC-32 of a file whose four bytes from offset `at` on count as zeros."""
    view = memoryview(data)
    return zlib.crc32(view[at + 4 :], zlib.crc32(bytes(4), zlib.crc32(view[:at])))
