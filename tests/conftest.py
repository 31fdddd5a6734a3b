import contextlib
import gc
from pathlib import Path

import jax
import pytest

from tests.helpers import quick as compiling


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes many objects, few of them garbage: to look for it took a tenth of the time.
gc.set_threshold(100_000, 20, 20)

# Every compiled program holds memory maps, of which Linux gives a process 65,530.
MANY_MAPS = 20_000

# Whole folders that only `--full` runs; single tests carry the marker `full`.
FULL_FOLDERS = {"examples", "stability"}


def pytest_addoption(parser):
    parser.addoption(
        "--full", action="store_true", help="run everything, not only the quick tests"
    )


def pytest_collection_modifyitems(config, items):
    """Leave out what only `--full` runs, unless its file or its marker was asked for."""
    if config.getoption("full") or config.getoption("markexpr"):
        return
    root = config.invocation_params.dir
    asked = {(root / argument.partition("::")[0]).resolve() for argument in config.args}

    def is_quick(item):
        in_folder = item.path.parent.name in FULL_FOLDERS
        return not (in_folder or item.get_closest_marker("full")) or item.path in asked

    left_out = [item for item in items if not is_quick(item)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if is_quick(item)]


@pytest.fixture(scope="session")
def is_full(request):
    """Whether everything was asked for: tests that draw many cases then draw all of them."""
    return request.config.getoption("full")


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """After a module that leaves too many programs behind."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()


@pytest.fixture(autouse=True, scope="session")
def quick_by_default(is_full):
    """Compile with little optimisation in the quick form, as users do in the full one."""
    with contextlib.nullcontext() if is_full else compiling.quickly():
        yield


@pytest.fixture
def quick():
    """Compile with little optimisation, in half to three quarters of the time.

    `tests/test_transforms.py` compares every function with and without it.
    """
    with compiling.quickly():
        yield


@pytest.fixture
def optimised():
    """Compile with all optimisation: for tests of what a program costs."""
    with compiling.optimised():
        yield
