"""Where the searches that may err do err. Each case is charted in `tests/stability`."""

import pytest

from benchmarks.scenes.reproject import cliff, error_rate, posts
from tests.helpers.forms import first


# From view to grazing: at least so often the method errs on posts, and on a cliff.
FAILURES = [
    ("descent", None, posts, 4, 0.02),
    ("descent", None, posts, 16, 0.1),
    ("descent", None, cliff, 16, 0.05),
    ("linear", 8, posts, 4, 0.02),
    ("linear", 8, posts, 16, 0.1),
    ("linear", 8, cliff, 16, 0.05),
    ("relief", 8, posts, 16, 0.1),
]


@pytest.mark.parametrize(("method", "steps", "make", "slope", "least"), FAILURES)
@pytest.mark.full
def test_where_a_quick_method_fails(method, steps, make, slope, least):
    assert error_rate(make(48), slope, method, steps) > least


@first("method", ["linear", "relief"])
@pytest.mark.full
def test_more_steps_err_less(method):
    rates = [error_rate(posts(48), 16, method, steps) for steps in (4, 64)]
    assert rates[0] > 2 * rates[1]
