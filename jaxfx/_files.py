"""Files written whole or not at all, under names that say what they are."""

import os
import secrets
from pathlib import Path


StrPath = str | os.PathLike[str]


def check_suffix(name: str, path: StrPath, suffix: str) -> None:
    """Raise `ValueError` if `path` ends in the suffix of another format."""
    found = Path(path).suffix
    if found and found.lower() != suffix:
        raise ValueError(f"`{name}` must end in `{suffix}`, the format, got `{path}`.")


def write_whole(path: StrPath, data: bytes | bytearray | memoryview) -> None:
    """Write a file whole or not at all: beside the old one, then into its place."""
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
