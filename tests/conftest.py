import gc
from pathlib import Path

import jax
import pytest

from tests.helpers.quick import quickly


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes many objects, few of them garbage: to look for it took a tenth of the time.
gc.set_threshold(100_000, 20, 20)

# Every compiled program holds memory maps, of which Linux gives a process 65,530.
MANY_MAPS = 20_000


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """After a module that leaves too many programs behind."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()


@pytest.fixture
def quick():
    """What a test compiles is compiled with little optimisation, in half to three quarters of
    the time. (`tests/test_transforms.py` compares every function with and without it.)"""
    with quickly():
        yield
