"""How a plan is found: what parts say, and what the whole scene says."""

import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxfx.budget._plan import Part, Search, timed
from jaxfx.budget._tiles import spend, sums, tile_of


class Way:
    """The picture, and something more in some rows; quick or slow."""

    title = "a way"

    def __init__(self, rows=slice(0), more=0.0, seconds=0.0):
        self.rows, self.more, self.seconds = rows, more, seconds

    def __call__(self, picture):
        time.sleep(self.seconds)
        return picture.at[self.rows].add(self.more)


def search(*ways, parts=True):
    picture = jnp.arange(40.0).reshape(10, 4)
    found = Search(Way(seconds=0.01), (picture,), 0.1, [Part((picture[:5],))] if parts else [])
    for index, way in enumerate(ways):
        found.trial(way, f"number {index}")
    return found.plan()


def test_what_parts_do_not_show_the_whole_scene_does():
    hidden, honest = Way(slice(5, 10), 1.0), Way(slice(0, 10), 0.05, 0.003)
    plan = search(hidden, honest)
    assert plan.recipe is honest
    np.testing.assert_allclose(plan.predicted_error, 0.05)
    assert "not taken: number 0: errs by 0.71." in str(plan)
    assert float(plan.predicted_seconds) < float(plan.full_seconds)


def test_without_parts_all_is_measured_once():
    assert search(Way(slice(5, 10), 1.0), parts=False).predicted_error == 0


def test_what_is_slower_than_the_effect_is_not_taken():
    plan = search(Way(slice(1), 0.01, 0.03))
    assert plan.predicted_error == 0
    assert "not taken: number 0: takes" in str(plan)


def test_every_way_is_called_once_before_it_is_timed_whatever_its_static_fields():
    called = []

    class Steps(eqx.Module):
        most: int = eqx.field(static=True)

        def __call__(self, picture):
            called.append(self.most)
            return picture

    for most in (1, 2, 2):
        timed(Steps(most), (jnp.ones(3),))
    assert called == [1, 1, 2, 2, 2]


def test_tiles_hold_their_own_pixels_and_no_others():
    image = np.random.default_rng(0).uniform(size=(19, 21))
    found = sums(image.reshape(1, -1), tile_of((19, 21)))[:, 0]
    rows = [image[i : i + 8, j : j + 8].sum() for i in (0, 8, 16) for j in (0, 8, 16)]
    np.testing.assert_allclose(found, rows)


def test_an_error_is_spent_on_the_cheapest_steps_in_their_order():
    squares = np.array([[0, 1, 5, 6], [0, 2, 3, 30], [0, 0, 0, 9]], float)
    for budget, steps in ((0, [0, 0, 2]), (1.1, [1, 0, 2]), (4.1, [1, 2, 2]), (9.1, [3, 2, 2])):
        np.testing.assert_array_equal(spend(squares, budget**0.5, 1), steps)
    assert squares[[0, 1, 2], spend(squares, 5.0, 2)].sum() <= 50
