"""The output folder of an example, and the message with which it ends on an error."""

import sys
import tempfile
from pathlib import Path
from typing import NoReturn


def fail(message: object) -> NoReturn:
    """End the program with an error message, on one line whatever a file is called."""
    line = " ".join(str(message).splitlines())
    sys.exit(f"{Path(sys.argv[0]).name}: error: {line}")


def make_folder(folder: Path) -> Path:
    """The folder, created if need be; an error is reported before the work, not after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        fail(f"--out must be a folder to write to: {error}")
    return folder
