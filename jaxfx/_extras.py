"""Imports of libraries that only an extra of the package installs."""

from types import TracebackType
from typing import final


class MissingExtraError(ImportError):
    """A library is not installed; the message names the extra that installs it."""


@final
class needs:
    """A context manager for imports of libraries that the plain installation lacks.

    `with needs("io"): import PIL` raises `MissingExtraError`, with the name of the extra, where
    the library is not installed. The error of one that is installed but fails to load is kept.
    """

    def __init__(self, extra: str):
        self.extra = extra

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, ModuleNotFoundError):
            raise MissingExtraError(
                f"{error}. It comes with an extra: pip install 'jaxfx[{self.extra}]'",
                name=error.name,
                path=error.path,
            ) from error
