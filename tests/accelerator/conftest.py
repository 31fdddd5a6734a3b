"""Here every effect runs the program that it has for accelerators, on whatever runs the tests.

The files import tests of the effects: the same oracles, values and derivatives hold for both
programs.
"""

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def on_accelerator(quick_by_default):
    """As if lowered for one, in programs kept apart by the precision (see `quick`)."""
    chosen = lambda *operands, cpu, default: default(*operands)
    with pytest.MonkeyPatch.context() as patch, jax.default_matmul_precision("high"):
        patch.setattr(jax.lax, "platform_dependent", chosen)
        yield
