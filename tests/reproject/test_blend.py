"""Several sources in one image, and the choice among them."""

import inspect
import re

import numpy as np
import pytest

from jaxfx import PinholeCamera
from jaxfx.reproject import blend, choose, warp


def camera(x=0.0, turn=0.0, height=16, width=24):
    pose = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[0, 3] = x
    return PinholeCamera.from_fov(0.9, height=height, width=width, world_from_camera=pose)


def box_before_a_wall(eye):
    """The depth of a wall at 4 with a box's front at 2, |x| < 0.4, and their two colours."""
    x = np.arange(24) + 0.5 - 12
    slope = x / float(eye.intrinsics[0, 0])
    on_box = np.abs(2 * slope + float(eye.world_from_camera[0, 3])) < 0.4
    depth = np.broadcast_to(np.where(on_box, 2.0, 4.0), (16, 24))
    return np.where(on_box, 1.0, 0.25)[None, :, None] * np.ones((16, 24, 3)), depth


@pytest.mark.full
def test_two_sources_fill_each_others_gaps():
    eyes = [camera(-0.5), camera(0.5)]
    images, depths = zip(*map(box_before_a_wall, eyes), strict=True)
    target = camera()
    truth, _ = box_before_a_wall(target)
    drawn, alpha = blend(images, depths, eyes, target)
    alone = [warp(*each, target)[1] for each in zip(images, depths, eyes, strict=True)]
    np.testing.assert_array_equal(alpha, np.maximum(*alone))
    assert alpha.mean() > 1.1 * max(a.mean() for a in alone)
    known = np.asarray(alpha) > 0
    assert (np.abs(drawn - truth).max(axis=-1)[known] < 1e-9).mean() > 0.95


def test_one_source_is_a_warp():
    eye = camera(0.3)
    image, depth = box_before_a_wall(eye)
    one, alpha = blend([image], [depth], [eye], camera())
    same, mask = warp(image, depth, eye, camera())
    np.testing.assert_allclose(one, same, atol=1e-12)
    np.testing.assert_array_equal(alpha, mask)


@pytest.mark.parametrize("first", [np.float32, np.float64])
def test_images_of_two_types_give_the_first_ones(first):
    eye, depth = camera(), np.full((16, 24), 2.0)
    other = np.float64 if first == np.float32 else np.float32
    images = [np.full((16, 24, 3), value, kind) for value, kind in ((1, first), (3, other))]
    drawn, alpha = blend(images, [depth] * 2, [eye] * 2, eye)
    assert drawn.dtype == alpha.dtype == first
    np.testing.assert_allclose(drawn, 2, rtol=1e-6)


def test_the_nearer_surface_hides_the_farther():
    eye = camera()
    near, far = np.full((16, 24), 2.0), np.full((16, 24), 5.0)
    bright, dark = np.ones((16, 24, 3)), np.zeros((16, 24, 3))
    drawn, _ = blend([dark, bright], [far, near], [eye, eye], eye)
    np.testing.assert_array_equal(drawn, 1)


@pytest.mark.full
def test_the_choice_is_what_shows_most_and_then_what_it_lacks():
    moves = [(0.0, 3.1), (-0.6, 0.0), (-0.5, 0.0), (0.7, 0.0)]
    eyes = [camera(*move) for move in moves]
    depths = [np.full((16, 24), 4.0), *(box_before_a_wall(eye)[1] for eye in eyes[1:])]
    target = camera(height=128, width=192)
    chosen, worth = choose(depths, eyes, target, count=2, height=128, width=192)
    # The nearest, and the one on the other side: not its neighbour, nor who looks away.
    assert chosen.tolist() == [2, 3]
    assert (np.diff(worth) >= 0).all() and 0 < worth[0] <= 1
    everything, _ = choose(depths, eyes, camera(), count=4)
    assert sorted(everything.tolist()) == [0, 1, 2, 3]


FAULTS = {
    "blend(images)": (blend, {"images": []}),
    "choose(depths)": (choose, {"depths": []}),
    "choose(count=...)": (choose, {"count": 3}),
}


@pytest.mark.parametrize(("name", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(name, fault):
    function, change = fault
    eye = camera()
    image, depth = box_before_a_wall(eye)
    given = {"depths": [depth], "cameras": [eye], "target": eye}
    given |= {"images": [image]} if function is blend else {"count": 1}
    with pytest.raises(ValueError, match=re.escape(f"`{name}`")):
        inspect.unwrap(function)(**given | change)
