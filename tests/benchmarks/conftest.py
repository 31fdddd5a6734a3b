"""The benchmarks need the extra `bench`, and run only when they are asked for."""

import importlib.util
from pathlib import Path

import pytest


# `pytest` after `pip install -e '.[test]'` has neither the timer nor the native peer: what is
# missing there is an option that was not asked for, not a failure.
if any(importlib.util.find_spec(name) is None for name in ("pytest_benchmark", "numba")):
    collect_ignore_glob = ["test_*.py"]


def pytest_collection_modifyitems(config, items):
    if not config.getoption("benchmark_only", default=False):
        reason = "timings are taken alone: pytest --benchmark-only tests/benchmarks"
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason=reason))
