"""The promises of a plan, tested on random scenes of each effect."""

import itertools
import statistics

import numpy as np
import pytest

from jaxfx.budget import _search


class Promises(list):
    """Plans, the errors that they were allowed, and those that they make."""

    def are_kept(self):
        for plan, allowed, error in self:
            assert error <= float(plan.predicted_error) * (1 + 1e-6) + 1e-12
            assert float(plan.predicted_error) <= allowed

    def are_made_use_of(self, least):
        """Most of the allowed error is spent, in at least this share of all plans."""
        slack = [allowed / error for _, allowed, error in self if error > 0]
        assert len(slack) >= least * len(self)
        assert statistics.median(slack) < 4


def of_images(result):
    """The image of a result, without its coverage."""
    return result[0] if isinstance(result, tuple) else result


@pytest.fixture
def later_is_quicker(monkeypatch):
    """Each candidate is quicker than those before: the last within the error is taken."""
    turns = itertools.count(1)
    timed = lambda call, data: (of_images(call(*data)), 1 / next(turns))
    monkeypatch.setattr(_search, "timed", timed)


@pytest.fixture(scope="session")
def promised(is_full):
    """`promised(scene, plan, effect, exponents)`: plans for errors within those powers of ten.

    There are 20 of them, or 200 with `--full`.

    On images so small no time tells a candidate from another: whatever errs more is said to be
    quicker, and so the plan that is chosen is the one that comes nearest to its bound.
    """

    def made(scene, plan, effect, exponents):
        rng, found, exact = np.random.default_rng(0), Promises(), {}

        def timed(call, data):
            image = of_images(call(*data))
            error = _search.mean_square(image - exact.setdefault(id(data), image))
            return image, 1 / (1 + float(error))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_search, "timed", timed)
            for _ in range(200 if is_full else 20):
                data, allowed = scene(rng), 10 ** rng.uniform(*exponents)
                chosen = plan(*data, max_error=allowed)
                difference = of_images(chosen(*data)) - of_images(effect(*data))
                found.append((chosen, allowed, float(_search.mean_square(difference)) ** 0.5))
                exact.clear()
        return found

    return made
