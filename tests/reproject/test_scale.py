"""Scenes of any size, from near to far: against the plane's own geometry in float64 NumPy."""

import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera
from jaxfx.reproject import blend, choose, warp
from tests.helpers.forms import first


HEIGHT, WIDTH, FOCAL = 16, 20, 24.0
LENS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
X, Y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
# At its own place, in lengths of the plane's distance: to the side, turned, back, on.
MOVES = {
    "own": ((0, 0, 0), 0.0),
    "aside": ((0.1, 0.05, 0), 0.0),
    "turned": ((0.1, 0.05, 0.2), 0.1),
    "far back": ((0.05, 0, -3), 0.0),
    "farther back": ((0, 0, -20), 0.0),
    "close": ((0, 0, 0.9), 0.0),
}


def pose(shift, turn):
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    matrix[:3, 3] = shift
    return matrix


def pinhole(matrix, dtype):
    return PinholeCamera(LENS.astype(dtype), matrix.astype(dtype))


def orthographic(matrix, distance, dtype):
    scale, centre = dtype(FOCAL / distance), np.array([WIDTH / 2, HEIGHT / 2], dtype)
    return OrthographicCamera(scale, centre, matrix.astype(dtype))


def on_plane(matrix, distance, is_orthographic):
    """The source's pixels of what a target sees of a plane, and whether it sees them."""
    across = np.stack([(X - WIDTH / 2) / FOCAL, (Y - HEIGHT / 2) / FOCAL], axis=-1)
    if is_orthographic:
        begin = distance * np.concatenate([across, np.zeros_like(across[..., :1])], axis=-1)
        ray = np.broadcast_to(matrix[:3, 2], begin.shape)
    else:
        begin = np.zeros((HEIGHT, WIDTH, 3))
        ray = np.concatenate([across, np.ones_like(across[..., :1])], -1) @ matrix[:3, :3].T
    begin = begin @ (matrix[:3, :3].T if is_orthographic else np.eye(3)) + matrix[:3, 3]
    depth = (distance - begin[..., 2]) / ray[..., 2]
    points = begin + depth[..., None] * ray
    return FOCAL * points[..., :2] / distance + [WIDTH / 2, HEIGHT / 2], depth > 0


@first("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stray", [None, 1e-4, 1e-9])
@pytest.mark.parametrize("distance", [1e-6, 1.0, 1e3, 1e10, 1e20, 1e37])
@pytest.mark.full
def test_a_plane_at_any_distance_and_with_a_stray_pixel_before_it(distance, stray, dtype):
    image, depth = np.stack([X, Y], axis=-1).astype(dtype), np.full(X.shape, distance, dtype)
    clear, low = np.ones(X.shape, bool), -2e-3
    if stray is not None:
        depth[0, 0] = stray * distance
    source = pinhole(np.eye(4), dtype)
    for shift, turn in MOVES.values():
        matrix = pose(np.array(shift) * distance, turn)
        for kind in ("pinhole", "orthographic"):
            target = pinhole(matrix, dtype)
            if kind == "orthographic":
                target = orthographic(matrix, distance, dtype)
            expected, ahead = on_plane(matrix, distance, kind == "orthographic")
            high = np.array([WIDTH, HEIGHT])
            inside = ahead & ((expected > -low) & (expected < high + low)).all(axis=-1)
            outside = ~ahead | ((expected < low) | (expected > high - low)).any(axis=-1)
            drawn, alpha = map(np.asarray, warp(image, depth, source, target))
            assert alpha[outside].sum() <= (stray is not None)
            # The stray pixel hides what an orthographic ray, from far aside, passes behind it.
            clear = (expected > 2).any(axis=-1) | (stray is None)
            hidden = (inside & clear & (alpha == 0)).sum()
            assert hidden <= (7 if stray and kind == "orthographic" else 0)
            inner = inside & clear & (alpha == 1)
            inner &= ((expected > 0.5) & (expected < high - 0.5)).all(axis=-1)
            tolerance = 1e-4 if dtype == np.float32 else 1e-9
            np.testing.assert_allclose(drawn[inner], expected[inner], rtol=0, atol=tolerance)


@pytest.mark.parametrize("sky", [1e7, 1e10, 1e20, 1e37])
@pytest.mark.full
def test_a_far_sky_is_the_sky(sky):
    """In `warp`, `blend` and `choose`, as one at infinity, which a test of its own holds."""
    rng = np.random.default_rng(0)
    image = rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    depth = np.full(X.shape, 4, np.float32)
    depth[6:12, 5:14] = 2
    aside = pinhole(pose((0.1, 0, 0), 0.0), np.float32)
    source = pinhole(np.eye(4), np.float32)
    for shift, turn in (((0, 0, 0), 0.0), ((0.2, 0.3, 0.3), 0.1), ((0, 0, -0.5), 0.0)):
        target, seen = pinhole(pose(shift, turn), np.float32), []
        for far in (np.inf, sky):
            depth[:5] = far
            lists = [depth, depth], [source, aside]
            one = warp(image, depth, source, target)
            both = blend([image, image], *lists, target)
            seen.append([*one, *both, choose(*lists, target, count=2).worth])
        for one, other in zip(*seen, strict=True):
            np.testing.assert_allclose(other, one, atol=2e-4)
        assert seen[1][1][:4].mean() > 0.6


def test_one_stray_pixel_hides_itself_alone():
    depth = np.full((8, 8), 1000, np.float32)
    depth[7, 7] = 1e-5
    eye = PinholeCamera.from_fov(0.9, height=8, width=8)
    image = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32)
    drawn, alpha = warp(image, depth, eye, eye)
    np.testing.assert_array_equal(alpha, 1)
    np.testing.assert_array_equal(drawn, image)
