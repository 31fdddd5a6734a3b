"""Progress bars on stderr, for calls with `progress=True`."""

from collections.abc import Iterable
from types import TracebackType
from typing import Any, final

from jaxfx._extras import needs


@final
class Bar:
    """A progress bar that counts steps, or nothing at all; a context manager.

    **Arguments:**

    - `is_shown`: whether there is a bar; only then is tqdm imported.
    - `title`: what is counted.
    """

    def __init__(self, is_shown: bool, title: str):
        self._bar = _tqdm()(desc=title, unit="step", leave=False) if is_shown else None

    def step(self, **figures: str) -> None:
        """Count one step, and show figures beside the bar."""
        if self._bar is not None:
            self._bar.update()
            self._bar.set_postfix(**figures)

    def __enter__(self) -> "Bar":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()


def counted(items: Iterable[Any], is_shown: bool, title: str) -> Iterable[Any]:
    """The items, counted by a progress bar if `is_shown`."""
    return _tqdm()(items, desc=title, leave=False) if is_shown else items


def _tqdm() -> Any:
    with needs("plot"):
        from tqdm.auto import tqdm
    return tqdm
