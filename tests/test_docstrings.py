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
