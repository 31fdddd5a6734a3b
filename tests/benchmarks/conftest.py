"""The benchmarks need the extra `bench`."""

import importlib.util


# `pytest` after `pip install -e '.[test]'` has neither the timer nor the native peer: what is
# missing there is an option that was not asked for, not a failure.
if any(importlib.util.find_spec(name) is None for name in ("pytest_benchmark", "numba")):
    collect_ignore_glob = ["test_*.py"]
