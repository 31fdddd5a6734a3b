"""Writing files: whole or not at all, and with the suffix of their format.

`exr`, `io`, `tradeoff`, the examples and the benchmarks write files by `write_whole`.
"""

import os
import secrets
from pathlib import Path


StrPath = str | os.PathLike[str]


def check_suffix(name: str, path: StrPath, suffix: str) -> None:
    """Raise `ValueError` if `path` has a suffix, and it is not that of the format."""
    actual = Path(path).suffix
    if actual and actual.lower() != suffix:
        raise ValueError(f"`{name}` must end in `{suffix}`, the format, got `{path}`.")


def write_whole(path: StrPath, data: bytes | bytearray | memoryview) -> None:
    """Write a file whole or not at all.

    The data go to a temporary file in the same folder, which then replaces the old one. On an
    error the old file stays as it was.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        reason = f"cannot write `{target.name}` here, {error.strerror}"
        raise OSError(error.errno, reason, str(target.parent)) from error
    try:
        temporary.write_bytes(data)
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
