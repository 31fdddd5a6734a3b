"""Libraries that come with an extra of the package."""

from types import TracebackType
from typing import final


class MissingExtraError(ImportError):
    """A library is not installed, and the message names the extra that brings it."""


@final
class needs:
    """A context for imports of libraries that the plain installation lacks.

    `with needs("io"): import PIL` raises a `MissingExtraError` that names the extra where the
    library is not installed. One that is installed and fails to load keeps its own error.
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
