"""Which caches are chosen: against closed forms, and by what they cover together."""

import inspect

import numpy as np
import pytest

from jaxfx import GBuffer, OrthographicCamera, PinholeCamera, relight
from tests.cases.relight_views import (
    CAMERAS,
    FRONTAL,
    HEIGHT,
    LARGE,
    TARGET,
    WIDTH,
    cache,
    orbit,
)


@pytest.mark.full
def test_the_first_sees_most_and_none_is_taken_twice(caches):
    gbuffers, cameras = caches
    target = orbit(12, 0.1, LARGE)
    depth = cache(target, LARGE).depth
    order, worth = map(
        np.asarray, relight.choose(gbuffers, cameras, target, depth=depth, count=8)
    )
    assert sorted(order) == list(range(8))
    assert order[0] == 5  # two degrees away; the next is six
    assert (np.diff(worth) >= 0).all()
    covered = lambda which: np.mean(
        relight.synthesize(
            [gbuffers[i] for i in which], [cameras[i] for i in which], target, depth=depth
        ).views
        > 0
    )
    # Three of them do better than the first three, and than any one.
    assert covered(order[:3]) > covered([0, 1, 2])
    assert covered(order[:1]) >= max(covered([i]) for i in range(8)) - 0.02


def test_one_that_looks_away_comes_last_and_adds_nothing():
    away = PinholeCamera.look_at(
        [0, 0, 0], [0, 0, -3], up=[0, -1, 0], fov_y=0.7, height=HEIGHT, width=WIDTH
    )
    cameras = [away, *CAMERAS]
    gbuffers = [FRONTAL(camera) for camera in cameras]
    depth = FRONTAL(TARGET).depth
    order, worth = relight.choose(gbuffers, cameras, TARGET, depth=depth, count=4, stride=3)
    assert int(order[-1]) == 0
    assert worth[-1] == worth[-2]


def wall(scale, width):
    """A frontal plane's cache of 8 scene units by `width`, from x = -4 on; and its camera."""
    height, columns = int(8 * scale), int(width * scale)
    colors, plane = np.ones((height, columns, 3)), np.ones((height, columns))
    normal = np.broadcast_to([0.0, 0.0, -1.0], colors.shape)
    gbuffer = GBuffer(
        *(colors, plane.astype(int), colors, colors, colors),
        *(normal, 3 * plane, plane),
    )
    return gbuffer, OrthographicCamera(scale, [4 * scale, 4 * scale], np.eye(4))


def test_worth_is_for_coverage_first_and_for_detail_after():
    """Half of the wall at twice the pixels per unit, and all of it: a quarter of the detail."""
    (fine, near), (coarse, far) = wall(2.0, 4), wall(1.0, 8)
    choice = relight.choose(
        [fine, coarse], [near, far], far, depth=coarse.depth, count=2, stride=1
    )
    np.testing.assert_array_equal(choice.chosen, [1, 0])
    # The fine pixel's centre, which it looks from, is a quarter unit aside along both axes.
    detail = (1 / 4) / (3 / np.sqrt(3**2 + 2 / 4**2))
    np.testing.assert_allclose(choice.worth, [((3 + detail) / 4 + 1) / 2, 1])


def test_errors_name_the_argument():
    choose = inspect.unwrap(relight.choose)
    gbuffer, depth = FRONTAL(TARGET), FRONTAL(TARGET).depth
    for count in (0, 2):
        with pytest.raises(ValueError, match=r"`choose\(count=...\)` must be in \[1, 1\]"):
            choose([gbuffer], [TARGET], TARGET, depth=depth, count=count)
    with pytest.raises(ValueError, match=r"`choose\(stride=...\)` must be at least 1"):
        choose([gbuffer], [TARGET], TARGET, depth=depth, count=1, stride=0)
