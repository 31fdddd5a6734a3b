"""Here every effect runs the program that it has for accelerators, on whatever runs the tests.

The files import tests of the effects: the same oracles, values and derivatives hold for both
programs.
"""

import pytest

from tests.helpers.quick import for_accelerators


@pytest.fixture(autouse=True, scope="module")
def on_accelerator(quick_by_default):
    """As if lowered for one."""
    with for_accelerators():
        yield
