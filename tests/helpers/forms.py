"""Which cases of a test run in the quick suite, and which with `--full` only."""

from collections.abc import Iterable
from typing import Any

import pytest


def first(names: str | tuple[str, ...], cases: Iterable[Any], count: int = 1, **options: Any):
    """Parametrize a test, and mark all but the first `count` of its cases `full`.

    For cases that run much the same code: programs of one sum, types, starts of a fit.
    `options` are those of `pytest.mark.parametrize`.
    """
    values = list(cases)
    for i, case in enumerate(values[count:], count):
        arguments = (case,) if isinstance(names, str) else case
        values[i] = pytest.param(*arguments, marks=pytest.mark.full)
    return pytest.mark.parametrize(names, values, **options)
