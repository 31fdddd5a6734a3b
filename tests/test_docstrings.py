"""The examples of the public docstrings run, and print what they say."""

import doctest
import inspect

import jax
import pytest

from tests.test_house import PUBLIC_OBJECTS


pytestmark = pytest.mark.full

EXAMPLES = {
    name: example
    for name, value in PUBLIC_OBJECTS.items()
    if (doc := inspect.getdoc(value.fget if isinstance(value, property) else value))
    and (example := doctest.DocTestParser().get_doctest(doc, {}, name, None, None)).examples
}


def _is_made_or_called(name, value):
    """A function, a class that users make or one of its constructors; no record, no method."""
    if isinstance(value, property) or getattr(value, "_is_protocol", False):
        return False
    if inspect.isclass(value):
        is_record = "**Arguments:**" not in (inspect.getdoc(value) or "")
        return not is_record and not issubclass(value, Exception)
    return name.count(".") == 1 or ".from_" in name or name.endswith(".look_at")


@pytest.mark.parametrize(
    "name", [name for name, value in PUBLIC_OBJECTS.items() if _is_made_or_called(name, value)]
)
def test_it_has_an_example(name):
    assert name in EXAMPLES


@pytest.fixture(autouse=True)
def as_users_have_it():
    """JAX's own defaults: float32, and promotion of types and ranks as JAX does it."""
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        yield


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_example(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    printed = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    runner = doctest.DocTestRunner(optionflags=flags, verbose=False)
    runner.run(EXAMPLES[name], out=printed.append)
    assert not runner.failures, "".join(printed)
