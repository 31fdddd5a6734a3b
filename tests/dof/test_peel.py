"""The guessed second layer against a loop over all pixels, and closed forms of edges."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof.peel import _nearest_behind
from tests.dof.test_layered import (
    EDGE,
    FOCUS,
    LENS,
    NEAR,
    SIZE,
    blurred,
    half_plane,
    hidden_share,
    one_layer,
    texture,
    two_layers,
)


# Half the difference in defocus of the two planes, and a pixel more.
SEEN = 6 + 1


@jax.jit
def peeled(image, depth, lens=LENS):
    return dof.peel(image, depth, lens, max_coc=12.0)


def nearest_behind(defocus, may_be_taken, threshold):
    """For each pixel the least square of a distance to one that it may hide; inf if none."""
    y, x = (a.ravel() for a in np.indices(defocus.shape))
    square = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
    gap = defocus.reshape(1, -1) - defocus.reshape(-1, 1)
    counts = (gap > threshold) & (np.sqrt(square) <= gap / 2 + 1) & may_be_taken.reshape(1, -1)
    return np.where(counts, square, np.inf).min(axis=1).reshape(defocus.shape)


def blobs(seed):
    """Defocus in pixels: smooth slopes, and discs before them."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((21, 26))
    defocus = rng.uniform(2, 6) + 0.3 * y * rng.uniform(-1, 1) + 0.3 * x * rng.uniform(-1, 1)
    for _ in range(5):
        row, column, radius = rng.uniform(0, 21), rng.uniform(0, 26), rng.uniform(0.5, 6)
        inside = (y - row) ** 2 + (x - column) ** 2 < radius**2
        defocus = np.where(inside, rng.uniform(-9, 3), defocus)
    return np.clip(defocus, -12, 12), rng.uniform(size=defocus.shape) < 0.95


nearest = jax.jit(
    lambda defocus, may_be_taken: _nearest_behind(defocus, may_be_taken, jnp.asarray(2.0), 12.0)
)


@pytest.mark.parametrize("seed", range(4))
def test_the_flood_finds_what_a_loop_over_all_pixels_finds(seed):
    defocus, may_be_taken = blobs(seed)
    found = jax.tree.map(np.asarray, nearest(defocus, may_be_taken))
    expected = nearest_behind(defocus, may_be_taken, 2.0)
    square = np.where(np.isinf(found.defocus), np.inf, found.down**2 + found.right**2)
    # A flood may miss the nearest, rarely, and never finds what is none.
    assert np.all(square >= expected)
    assert np.mean(square == expected) > 0.98
    some = np.isfinite(found.defocus)
    assert some.mean() > 0.05
    y, x = np.indices(defocus.shape)
    row, column = y + found.down.astype(int), x + found.right.astype(int)
    assert np.array_equal(defocus[row, column][some], found.defocus[some])
    assert may_be_taken[row, column][some].all()


def test_a_plane_goes_on_behind_an_edge():
    """As far as the lens sees past it: the nearest column, averaged over three rows."""
    wall = texture(1)
    image, depth, _ = half_plane(texture(2), NEAR, wall, FOCUS)
    color, farther = peeled(image, depth)
    hidden = slice(EDGE - SEEN, EDGE)
    known = np.zeros(SIZE, bool)
    known[:, hidden] = True
    assert np.array_equal(farther, np.where(known, FOCUS, 0))
    assert not color[~known].any()
    column = wall[:, EDGE]
    expected = np.stack([column[max(y - 1, 0) : y + 2].mean(axis=0) for y in range(SIZE[0])])
    assert np.abs(color[:, hidden] - expected[:, None]).max() < 1e-12


def test_an_edge_before_a_plane_shows_what_goes_on_behind_it():
    """The plane is the same all along the rows: only the mean of three differs."""
    wall = np.broadcast_to(blurred(texture(3), 2.0)[:, :1], (*SIZE, 3))
    color = np.array([1.0, 0.5, 0.1])
    image, depth, _ = half_plane(color, NEAR, wall, FOCUS)
    share = hidden_share(6.0)
    exact = share * color + (1 - share) * wall
    guessed = two_layers(image, depth, peeled(image, depth))
    assert np.abs(guessed - exact).max() < 0.04
    assert np.abs(one_layer(image, depth) - exact).max() > 0.2


def test_a_steep_surface_hides_nothing():
    """Up to a pixel of defocus a pixel: the lens then sees each of its points."""
    depth = 24 / (12 - np.clip(0.95 * (np.arange(SIZE[1]) - 32), -12, 11.9))
    assert not peeled(texture(4), np.broadcast_to(depth, SIZE))[1].any()


def test_only_known_pixels_are_taken():
    """None of the background, without a depth or without a colour; nor anything for them."""
    near, wall = texture(5), texture(6)
    image, depth, _ = half_plane(near, NEAR, wall, FOCUS)
    depth = depth.copy()
    image[4, EDGE : EDGE + 2] = np.nan
    depth[12, EDGE], depth[16, EDGE - 1], depth[16, EDGE + 1] = 0, np.nan, np.inf
    color, farther = peeled(image, depth)
    assert np.isfinite(color).all()
    assert set(np.unique(farther)) == {0, FOCUS}
    assert farther[16, EDGE - 1] == 0
    assert farther[4, EDGE - 1] == farther[12, EDGE - 1] == FOCUS
    assert not peeled(near, half_plane(near, NEAR, wall, np.inf)[1])[1].any()


def test_colour_and_depth_pass_their_derivatives():
    """A flat edge: each hidden pixel's colour is a mean of three, its depth is one."""
    wall = texture(7)
    image, depth, _ = half_plane(texture(8), NEAR, wall, FOCUS)
    depth = jnp.asarray(depth)

    @jax.jit
    def pull(image, depth):
        total = lambda image, depth: [jnp.sum(x) for x in peeled(image, depth)]
        return jax.jacrev(total, (0, 1))(jnp.asarray(image), depth)

    (by_color, none), (nothing, by_depth) = pull(image, depth)
    rows = np.full(SIZE[0], float(SEEN))
    # A row at the frame is in the means of two pixels and of three, any other of three times 3.
    rows[[0, -1]] = SEEN * (1 / 2 + 1 / 3)
    rows[[1, -2]] = SEEN * (1 / 2 + 2 / 3)
    expected = np.zeros(SIZE)
    expected[:, EDGE] = rows
    assert np.abs(by_color - expected[..., None]).max() < 1e-12
    at_edge = np.where(np.arange(SIZE[1]) == EDGE, float(SEEN), 0.0)
    assert np.abs(by_depth - at_edge[None]).max() < 1e-12
    assert not none.any() and not nothing.any()


def test_faults_are_named():
    peel = inspect.unwrap(dof.peel)
    image, depth = texture(), np.full(SIZE, 2.0)
    with pytest.raises(ValueError, match=r"peel\(threshold=...\)` must be 0 or positive"):
        peel(image, depth, LENS, threshold=-1.0)
    with pytest.raises(ValueError, match=r"peel\(max_coc=...\)` must be positive"):
        peel(image, depth, LENS, max_coc=-3)
    with pytest.raises(ValueError, match=r"peel\(depth\)` must have the image's height"):
        peel(image, depth[1:], LENS)


def test_no_aperture_hides_nothing():
    image, depth, _ = half_plane(texture(), NEAR, texture(9), FOCUS)
    assert not peeled(image, depth, ThinLens(0.0, 2.0, 24.0))[1].any()
