"""The benchmarks need the extra `bench`."""

import importlib.util

import pytest


missing = [n for n in ("pytest_benchmark", "numba", "cv2") if not importlib.util.find_spec(n)]
if missing:
    raise pytest.UsageError(f"{', '.join(missing)} not found: pip install -e '.[bench]'")
