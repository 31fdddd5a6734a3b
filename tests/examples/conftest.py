from pathlib import Path

import pytest


@pytest.fixture(autouse=True, scope="module")
def as_a_script():
    """What Python itself does for `python examples/NAME.py`: that folder comes first."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2] / "examples")
        yield
