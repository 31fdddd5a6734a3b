"""How an example begins, and how it ends where it can't go on."""

import sys
import tempfile
from pathlib import Path
from typing import NoReturn


def fail(message: object) -> NoReturn:
    sys.exit(f"{Path(sys.argv[0]).name}: error: {message}")


def make_folder(folder: Path) -> Path:
    """The folder, made if need be; said now rather than after the work."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        fail(f"--out must be a folder to write to: {error}")
    return folder
