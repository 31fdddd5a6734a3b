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
MANY_MAPS = 40_000

# Whole folders that only `--full` runs; single tests carry the marker `full`.
FULL_FOLDERS = {"accelerator", "examples", "stability"}
# What runs tests of other folders again: of them, only those without the marker, unless named.
AGAIN = "accelerator"

# The file that takes longest is begun first, or one process would end with it alone.
LONGEST = "test_transforms.py"


def pytest_addoption(parser):
    parser.addoption(
        "--full", action="store_true", help="run everything, not only the quick tests"
    )


def _named(config):
    """Whether a path, or the folder that only `--full` runs, stands on the command line."""
    root = config.invocation_params.dir
    named = {(root / argument.partition("::")[0]).resolve() for argument in config.args}

    def is_named(path):
        folder = path if path.is_dir() else path.parent
        return path in named or (folder.name in FULL_FOLDERS and folder in named)

    return is_named


def _takes_all(config):
    """Whether `--full` or a marker is asked for."""
    return config.getoption("full") or bool(config.getoption("markexpr"))


def pytest_ignore_collect(collection_path, config):
    """Import no folder that only `--full` runs, unless it or a file in it was named."""
    if collection_path.name not in FULL_FOLDERS:
        return None
    paths = [collection_path, *collection_path.glob("*.py")]
    return not (_takes_all(config) or any(map(_named(config), paths))) or None


def pytest_collection_modifyitems(config, items):
    """Leave out what only `--full` runs, unless its folder, its file or a marker was named."""
    is_named, takes_all = _named(config), _takes_all(config)

    def is_marked(item):
        return bool(item.get_closest_marker("full"))

    def is_full(item):
        return is_marked(item) or item.path.parent.name in FULL_FOLDERS

    def is_left_out(item):
        if is_named(item.path):
            return False
        if takes_all:
            return is_marked(item) and item.path.parent.name == AGAIN
        return is_full(item)

    left_out = {item for item in items if is_left_out(item)}
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    if not any(map(is_full, items)):
        compiling.use_older_generator()
    items.sort(key=lambda item: item.path.name != LONGEST)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Spread files over processes, so that what a file's tests share is computed once."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False  # It would begin with files of many quick tests.
    return LoadFileScheduling(config, log)


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
def quick_by_default():
    """Compile with little optimisation, and trace this platform's programs alone.

    `tests/test_transforms.py` compares every function with and without it.
    """
    with compiling.quickly():
        yield


@pytest.fixture
def optimised():
    """Compile with all optimisation, for all platforms, as users do: for published figures."""
    with compiling.optimised():
        yield
