"""How a plan is chosen: by trials on parts, and measurements on the whole scene."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx.budget import _search
from jaxfx.budget._search import Part, Search, timed


class Candidate:
    """The image with something added in some rows; its seconds are of the tests' clock."""

    title, now = "a candidate", 0.0

    def __init__(self, rows=slice(0), more=0.0, seconds=0.0):
        self.rows, self.more, self.seconds = rows, more, seconds

    def __call__(self, image):
        Candidate.now += self.seconds
        return image.at[self.rows].add(self.more)


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """A clock that only a `Candidate` advances."""
    monkeypatch.setattr(_search.time, "perf_counter", lambda: Candidate.now)


def search(*candidates, parts=True):
    image = jnp.arange(40.0).reshape(10, 4)
    found = Search(
        Candidate(seconds=0.01), (image,), 0.1, [Part((image[:5],))] if parts else []
    )
    for index, candidate in enumerate(candidates):
        found.trial(candidate, f"number {index}")
    return found.plan()


def test_what_parts_do_not_show_the_whole_scene_does():
    hidden, honest = Candidate(slice(5, 10), 1.0), Candidate(slice(0, 10), 0.05, 0.003)
    plan = search(hidden, honest)
    assert plan.recipe is honest
    np.testing.assert_allclose(plan.predicted_error, 0.05)
    assert "not taken: number 0: errs by 0.71." in str(plan)
    seconds = plan.predicted_seconds, plan.full_seconds
    np.testing.assert_allclose(seconds, (0.003, 0.01), rtol=1e-6)


def test_without_parts_all_is_measured_once():
    assert search(Candidate(slice(5, 10), 1.0), parts=False).predicted_error == 0


def test_what_is_slower_than_the_effect_is_not_taken():
    plan = search(Candidate(slice(1), 0.01, 0.03))
    assert plan.predicted_error == 0
    assert "not taken: number 0: takes 3 of the effect's time on parts." in str(plan)


def test_every_candidate_is_called_once_before_it_is_timed_whatever_its_static_fields():
    called = []

    class Steps(eqx.Module):
        most: int = eqx.field(static=True)

        def __call__(self, image):
            called.append(self.most)
            return image

    for most in (1, 2, 2):
        timed(Steps(most), (jnp.ones(3),))
    assert called == [1, 1, 2, 2, 2]
