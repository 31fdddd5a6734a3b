"""What every plan promises, tried on two hundred random scenes of each effect."""

import itertools
import statistics

import numpy as np
import pytest

from jaxfx.budget import _plan


class Promises(list):
    """Plans, the errors that they were allowed, and those that they make."""

    def are_kept(self):
        for plan, allowed, error in self:
            assert error <= float(plan.predicted_error) * (1 + 1e-6) + 1e-12
            assert float(plan.predicted_error) <= allowed

    def are_made_use_of(self, least):
        """Most of the error allowed is spent, where any can be."""
        slack = [allowed / error for _, allowed, error in self if error > 0]
        assert len(slack) >= least
        assert statistics.median(slack) < 4


def of_pictures(result):
    """The picture, without a coverage."""
    return np.asarray(result[0] if isinstance(result, tuple) else result)


@pytest.fixture(scope="session")
def promised():
    """`promised(scene, plan, effect, exponents)`: 200 plans for errors within those powers.

    On pictures so small no time tells a way from another: whatever is tried later is said to be
    quicker, and all of it than the effect.
    """

    def made(scene, plan, effect, exponents):
        rng, found, later = np.random.default_rng(0), Promises(), itertools.count(1)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_plan, "timed", lambda call, data: (call(*data), 1 / next(later)))
            for _ in range(200):
                data, allowed = scene(rng), 10 ** rng.uniform(*exponents)
                chosen = plan(*data, max_error=allowed)
                difference = of_pictures(chosen(*data)) - of_pictures(effect(*data))
                found.append((chosen, allowed, float(np.sqrt(np.mean(difference**2)))))
        return found

    return made
