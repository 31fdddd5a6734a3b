"""Images from other cameras, against cameras, planes and meshes whose view is known."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import reproject as cases
from benchmarks.scenes.reproject import camera
from jaxfx import OrthographicCamera, PinholeCamera, scene
from jaxfx.reproject import warp
from tests.helpers.forms import first


def picture(height=24, width=32):
    y, x = np.mgrid[:height, :width] / height
    return np.stack([np.sin(7 * x + y), np.cos(5 * y - x), x * y], axis=-1) + 1.5


@first("method", ["descent", "linear"])
def test_the_same_camera_gives_the_same_picture(method):
    """In float32. That of "pyramid", in both types, is asked in `tests/stability`."""
    rng = np.random.default_rng(0)
    image = rng.random((24, 32, 3)).astype(np.float32)
    depth = rng.uniform(1, 9, (24, 32)).astype(np.float32)
    depth[rng.random((24, 32)) < 0.2] = np.inf
    eye = camera(at=(3.1, -2.2, 0.7), turn=0.3)
    drawn, alpha = warp(image, depth, eye, eye, search=method)
    np.testing.assert_array_equal(drawn, image)
    np.testing.assert_array_equal(alpha, 1)
    assert drawn.dtype == alpha.dtype == np.float32


@first("move", [(0.3, 0.1, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, -0.5)])
def test_a_plane_moves_by_its_homography(move):
    """A linear image of a fronto-parallel plane, read where the plane's points project to."""
    y, x = np.mgrid[:24, :32] + 0.5
    image, depth = np.stack([x, y], axis=-1), np.full((24, 32), 2.0)
    source, target = camera(), camera(at=move)
    drawn, alpha = warp(image, depth, source, target)
    points = target.unproject(jnp.stack([x, y], axis=-1), jnp.full(x.shape, 2.0 - move[2]))
    expected = np.asarray(source.project(points)[0])
    inside = ((expected > 0) & (expected < (32, 24))).all(axis=-1)
    np.testing.assert_array_equal(alpha > 0, inside)
    assert drawn.dtype == alpha.dtype == np.float64
    inner = ((expected > 0.5) & (expected < (31.5, 23.5))).all(axis=-1)
    np.testing.assert_allclose(drawn[inner], expected[inner], atol=1e-9)
    assert not np.asarray(drawn)[~np.asarray(inside)].any()


@pytest.mark.full
def test_from_its_own_camera_a_plane_has_the_derivative_of_its_homography():
    """Every pixel reads the centre of a texel, where the three others have a share of 0."""
    y, x = np.mgrid[:24, :32] + 0.5
    image, depth, eye = np.stack([x, y], axis=-1), np.full((24, 32), 2.0), camera()

    def drawn(move):
        pose = eye.world_from_camera.at[:3, 3].add(move)
        return warp(image, depth, eye, PinholeCamera(eye.intrinsics, pose))[0]

    jacobian = np.asarray(jax.jit(jax.jacfwd(drawn))(jnp.zeros(3)))
    focal = float(eye.intrinsics[0, 0])
    # Pixel u sees f X / Z + c of the source, with X = (u - c) / f * (Z - move[2]) + move[0].
    forward = -(image - [16, 12]) / 2
    sideways = np.broadcast_to(np.eye(2) * focal / 2, (24, 32, 2, 2))
    expected = np.concatenate([sideways, forward[..., None]], axis=-1)
    inner = np.s_[:-1, :-1]  # the last texel has no neighbour
    np.testing.assert_allclose(jacobian[inner], expected[inner], atol=1e-9)


def test_the_sky_turns_with_the_camera():
    image, depth = picture(), np.full((24, 32), np.inf)
    drawn, alpha = warp(image, depth, camera(), camera(at=(5.0, 1.0, -3.0), turn=0.2))
    turned, same = warp(image, np.full((24, 32), 4.0), camera(), camera(turn=0.2))
    np.testing.assert_array_equal(alpha, same)
    np.testing.assert_allclose(drawn, turned, atol=1e-9)
    assert 0.5 < alpha.mean() < 0.9


def test_from_behind_nothing_is_seen_but_what_lies_ahead():
    image, depth = picture(), np.full((24, 32), 2.0)
    away = warp(image, depth, camera(), camera(at=(0, 0, 1.0), turn=np.pi))[1]
    assert not away.any()
    # Beyond the wall, looking back at it: its back was not seen.
    back = warp(image, depth, camera(), camera(at=(0, 0, 4.0), turn=np.pi))[1]
    assert not back.any()


def test_an_orthographic_target():
    y, x = np.mgrid[:24, :32] + 0.5
    image, depth = np.stack([x, y], axis=-1), np.full((24, 32), 2.0)
    target = OrthographicCamera(20.0, [16.0, 12.0], np.eye(4))
    drawn, alpha = warp(image, depth, camera(), target)
    points = target.unproject(jnp.stack([x, y], axis=-1), jnp.full(x.shape, 2.0))
    expected = np.asarray(camera().project(points)[0])
    inner = ((expected > 0.5) & (expected < (31.5, 23.5))).all(axis=-1)
    assert inner.sum() > 100 and alpha[inner].all()
    np.testing.assert_allclose(drawn[inner], expected[inner], atol=1e-9)


def test_holes_are_not_read_and_do_not_spread():
    image, depth = picture(), np.full((24, 32), 2.0)
    whole, _ = warp(image, depth, camera(), camera(at=(0.1, 0, 0)))
    for hole in (0.0, np.nan):
        holed, hurt = depth.copy(), image.copy()
        holed[10:14, 12:16], hurt[10:14, 12:16] = hole, np.nan
        drawn, alpha = warp(hurt, holed, camera(), camera(at=(0.1, 0, 0)))
        assert np.isfinite(drawn).all()
        assert 10 <= (np.asarray(alpha) == 0)[9:15, 10:17].sum() <= 24
        far = np.ones((24, 32), bool)
        far[8:16, 8:18] = False
        far[:, :3] = False
        np.testing.assert_allclose(np.asarray(drawn)[far], np.asarray(whole)[far], atol=1e-12)


@pytest.mark.parametrize("threshold", [0.1, 3.0])
@pytest.mark.full
def test_a_cliff_opens_a_gap_unless_it_counts_as_one_surface(threshold):
    image, depth = picture(), np.full((24, 32), 4.0)
    depth[:, 16:] = 2.0
    _, alpha = warp(image, depth, camera(), camera(at=(0.4, 0, 0)), hole_threshold=threshold)
    # The gap's width: the parallax between the two depths.
    focal = float(camera().intrinsics[0, 0])
    closed = float((1 - alpha[:, :27]).sum(axis=1).mean())
    _, left = warp(image, depth, camera(), camera(at=(-0.4, 0, 0)), hole_threshold=threshold)
    gap = float((1 - left[:, 8:]).sum(axis=1).mean())
    assert closed == 0
    assert gap == (0 if threshold == 3.0 else pytest.approx(0.4 * focal / 4, abs=1.0))


@pytest.mark.full
def test_the_still_life_turned_against_the_still_life_rendered():
    source, photograph = cases.photographer(scene.still_life(), 96)
    image, depth = photograph(source)
    mesh = cases.depth_mesh(depth, source)
    ours, peers = {}, {}
    for degrees in (5, 20, 40):
        target = cases.orbit(source, degrees, 2.8)
        truth, target_depth = photograph(target)
        seen = cases.visible(depth, source, target, target_depth)
        drawn = warp(image, depth, source, target)
        ours[degrees] = cases.scores(*drawn, truth, seen)
        traced = cases.trace(mesh, image, source, target, depth.shape)
        peers[degrees] = cases.scores(*traced, truth, seen)
        told = cases.backward_warp(image, target_depth, source, target)
        # The peer that is told the target's depth draws what the source did not see.
        assert cases.scores(*told, truth, seen)["false hits"] > 0.1
        # Where both show something, it is the same.
        both = np.asarray(drawn[1] * traced[1]) > 0
        apart = np.abs(np.asarray(drawn[0] - traced[0])).max(axis=-1)[both]
        assert (apart < 0.05).mean() > 0.8, degrees
        assert both.sum() / traced[1].sum() > 0.2
    assert min(score["PSNR"] for score in ours.values()) > 20, ours
    assert max(score["false hits"] for score in ours.values()) < 0.015, ours
    # What passes behind a near thing counts as unseen, though it may come out again: the
    # difference to the mesh, whose surfaces have backs.
    assert max(score["false holes"] for score in ours.values()) < 0.35, ours
    assert max(score["false holes"] for score in peers.values()) < 0.15, peers
    assert ours[5]["coverage"] > 0.6 > ours[20]["coverage"] > ours[40]["coverage"]


def smooth_depth():
    y, x = np.mgrid[:24, :32] / 24
    return 2 + 0.1 * np.sin(4 * x) * np.cos(3 * y)


@pytest.mark.full
def test_derivatives_of_the_pose_and_the_depth_are_the_difference_quotients():
    image, depth = picture(), smooth_depth()
    source = camera()

    def drawn(move, depth):
        pose = camera(at=(0.1, 0.05, 0.1), turn=0.03).world_from_camera.at[:3, 3].add(move)
        target = PinholeCamera(source.intrinsics, pose)
        return warp(image, depth, source, target)[0][6:18, 8:24]

    @jax.jit
    def derivatives(along, weight):
        step = lambda s: drawn(s * along[0], depth + s * along[1])
        at = (jnp.zeros(3), jnp.asarray(depth))
        pushed, pulled = jax.jvp(drawn, at, along)[1], jax.vjp(drawn, *at)[1](weight)
        product = sum(jnp.vdot(p, v) for p, v in zip(pulled, along, strict=True))
        return pushed, (step(1e-6) - step(-1e-6)) / 2e-6, product

    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(12, 16, 3)))
    for along in (
        (jnp.array([1.0, 0.5, -0.7]), jnp.zeros((24, 32))),
        (jnp.zeros(3), jnp.asarray(rng.normal(size=(24, 32)))),
    ):
        pushed, quotient, product = derivatives(along, weight)
        close = np.isclose(pushed, quotient, rtol=1e-4, atol=1e-5)
        # A few pixels read across the border of a patch.
        assert close.mean() > 0.98
        assert float(product) == pytest.approx(float(jnp.vdot(weight, pushed)), rel=1e-9)


@pytest.mark.full
def test_under_vmap_and_in_any_shape():
    image, depth = picture(), smooth_depth()
    moves = jnp.array([[0.1, 0, 0], [0, 0.2, 0.1]])

    def drawn(move):
        pose = jnp.eye(4).at[:3, 3].add(move)
        target = PinholeCamera(camera(5, 7).intrinsics, pose)
        return warp(image, depth, camera(), target, height=5, width=7)

    images, alphas = jax.jit(jax.vmap(drawn))(moves)
    assert images.shape == (2, 5, 7, 3) and alphas.shape == (2, 5, 7)
    single = jax.jit(drawn)
    for move, image_, alpha in zip(moves, images, alphas, strict=True):
        one, mask = single(move)
        np.testing.assert_allclose(image_, one, atol=1e-12)
        np.testing.assert_array_equal(alpha, mask)


FAULTS = {
    "warp(image)": {"image": np.ones((4, 4))},
    "warp(depth)": {"depth": np.ones((4, 5))},
    "warp(camera)": {"camera": OrthographicCamera(1.0, [0.0, 0.0], np.eye(4))},
    "warp(target)": {"target": None},
    "warp(height=...)": {"height": 0, "width": 3},
    "warp(width=...)": {"height": 3},
    "warp(search=...)": {"search": "fast"},
    "warp(hole_threshold=...)": {"hole_threshold": 0},
}


@pytest.mark.parametrize(("name", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(name, fault):
    given = {
        "image": picture(),
        "depth": smooth_depth(),
        "camera": camera(),
        "target": camera(),
    }
    with pytest.raises(ValueError, match=re.escape(f"`{name}`")):
        inspect.unwrap(warp)(**given | fault)
