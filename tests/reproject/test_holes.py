"""Holes in the depth: what is drawn beside them, and that no derivative is lost to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera
from jaxfx.reproject import blend, choose, intersect, warp
from tests.helpers.forms import first


MISSING = (0.0, -0.0, -1.0, -np.inf, np.nan)
HEIGHT, WIDTH = 12, 16


def camera(at=(0.0, 0.0, 0.0), turn=0.0, height=HEIGHT, width=WIDTH):
    pose = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = at
    return PinholeCamera.from_fov(0.9, height=height, width=width, world_from_camera=pose)


def splat(depth_at, shape, source, target):
    """Which source pixel each target pixel's centre shows, by a cloud of points; -1 for none.

    Of the points that fall on a pixel and have none far before them, the one nearest to its
    centre.
    """
    height, width = shape
    part = (np.arange(12) + 0.5) / 12
    x, y = np.meshgrid(*((np.arange(n)[:, None] + part).ravel() for n in (width, height)))
    points = source.unproject(jnp.asarray(np.stack([x, y], -1)), jnp.asarray(depth_at(x, y)))
    pixels, z = (np.asarray(v).reshape(x.size, -1) for v in target.project(points))
    z, place = z[:, 0], np.floor(pixels).astype(int)
    inside = ((place >= 0) & (place < (width, height))).all(axis=-1) & (z > 0)
    shown = np.flatnonzero(inside)
    at = (place[:, 1] * width + place[:, 0])[shown]
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, at, z[shown])
    off = np.where(z[shown] < 1.05 * nearest[at], np.abs(pixels - place - 0.5)[shown].max(1), 9)
    owner = np.full(height * width, -1)
    farthest_first = np.argsort(-off, kind="stable")
    of = y.astype(int) * width + x.astype(int)
    owner[at[farthest_first]] = of.ravel()[shown][farthest_first]
    return owner.reshape(shape)


@pytest.mark.parametrize("hole", [*MISSING, np.inf])
@pytest.mark.full
def test_a_stereo_pair_draws_its_own_pixels_and_no_pixel_of_a_hole(hole):
    """The plane keeps its pixels in the other view, so that the hole does."""
    height, width, focal, distance, baseline = 8, 96, 995.0, 2.75, 0.193
    left = np.array([[focal, 0, 48], [0, focal, 4], [0, 0, 1]])
    right, pose = left.copy(), np.eye(4)
    right[0, 2] += focal * baseline / distance
    pose[0, 3] = baseline
    image = np.broadcast_to(np.arange(width)[None, :, None] / width, (height, width, 1))
    depth = np.full((height, width), distance)
    depth[:, 40:60] = hole
    eyes = PinholeCamera(left, np.eye(4)), PinholeCamera(right, pose)
    drawn, alpha = map(np.asarray, warp(image, depth, *eyes))
    own = np.isfinite(depth) & (depth > 0)
    np.testing.assert_array_equal(alpha[own], 1)
    np.testing.assert_allclose(drawn[own], image[own], atol=1e-9)
    assert not alpha[:, 41:59].any() and not drawn[:, 41:59].any()
    if not np.isinf(hole) or hole < 0:
        assert not alpha[~own].any()


@first("method", ["pyramid", "descent", "linear", "relief"])
@pytest.mark.full
def test_beside_holes_a_slanted_floor_is_what_a_splat_of_its_points_shows(method):
    height, width = 48, 64
    source, target = (camera(at, 0.0, height, width) for at in ((0, 0, 0), (0.3, -0.1, 0.2)))
    depth_at = lambda x, y: 5 - 2.5 * y / height + 0.3 * np.sin(x / 7)
    y, x = np.mgrid[:height, :width] + 0.5
    depth = depth_at(x, y)
    rng = np.random.default_rng(0)
    is_hole = rng.random(depth.shape) < 0.02
    is_hole[10:20, 20:34] = is_hole[30:36, 40:50] = True
    shown = splat(depth_at, depth.shape, source, target)
    image = np.stack([x / width, y / height], axis=-1)
    holed = np.where(is_hole, rng.choice(MISSING, depth.shape), depth)
    hurt = np.where(is_hole[..., None], np.nan, image)
    drawn, alpha = map(np.asarray, warp(hurt, holed, source, target, search=method))
    assert np.isfinite(drawn).all() and not drawn[alpha == 0].any()
    where = shown >= 0
    of_hole = where & is_hole.ravel()[shown]
    own = where & ~of_hole
    assert of_hole.sum() > 250 and not alpha[of_hole].any()
    # A texel of a slanted surface, beside a hole, ends flat: rays pass below its border.
    assert alpha[own].mean() > 0.98
    # As the centres of the pixels that are shown, to half a pixel.
    off = np.abs(drawn - image.reshape(-1, 2)[shown])[own & (alpha > 0)]
    assert np.median(off) < 0.25 / height and (off < 0.7 / height).all()


@pytest.mark.full
def test_the_colour_before_a_hole_is_its_own_pixels():
    """A patch beside a hole is that of the known texels: their colour, to the border."""
    image = np.broadcast_to(np.arange(WIDTH)[None, :, None], (HEIGHT, WIDTH, 1)) * 1.0
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, 8:] = np.nan
    pixel = 2 / float(camera().intrinsics[0, 0])
    for shift in (0.2, 0.4, 0.49):
        drawn, alpha = warp(image, depth, camera(), camera((shift * pixel, 0, 0)))
        np.testing.assert_array_equal(np.asarray(alpha)[:, 1:8], 1)
        np.testing.assert_allclose(drawn[:, 7], 7, atol=1e-9)
        np.testing.assert_array_equal(np.asarray(alpha)[:, 8:], 0)


@pytest.mark.full
def test_a_search_that_starts_on_a_border_of_texels_behind_a_wall_has_seen_nothing():
    """From behind, rays come into the frustum beyond the wall: on a texel's border, some."""
    depth, image = np.full((16, 20), 2.0), np.ones((16, 20, 1))
    for back in (2.5, 6.0, 50.0):
        _, alpha = warp(
            image, depth, *(camera((0, 0, -z), 0.0, 16, 20) for z in (0.0, back * 2))
        )
        x, y = np.meshgrid(np.arange(20) + 0.5 - 10, np.arange(16) + 0.5 - 8)
        seen = (np.abs(x) * (1 + back) < 10) & (np.abs(y) * (1 + back) < 8)
        np.testing.assert_array_equal(alpha > 0, seen)


def surface():
    y, x = np.mgrid[:HEIGHT, :WIDTH] / HEIGHT
    image = np.stack([np.sin(4 * x + y), np.cos(3 * y - x)], axis=-1) + 1.5
    return image, 2 + 0.1 * np.sin(4 * x) * np.cos(3 * y)


def with_hole(hole, kind):
    """An image and its depth with one hole, with a block, or with one known pixel."""
    image, depth = surface()
    if kind == "one":
        depth[5, 7] = hole
    elif kind == "block":
        depth[4:8, 5:9] = hole
        if not hole > 0:
            image[5:7, 6:8] = np.nan
    else:
        depth[np.arange(depth.size).reshape(depth.shape) != 6 * WIDTH + 8] = hole
    return jnp.asarray(image), jnp.asarray(depth)


TARGETS = {
    "own": camera(),
    "moved": camera((0.1, 0.05, 0.1), 0.03),
    "back": camera((0, 0, -0.4)),
    "away": camera((0, 0, 1), np.pi),
    "beside": camera((3, 0, 0), np.pi / 2),
    "across": camera((0.5, 0, 1.5), -np.pi / 2),
    "orthographic": OrthographicCamera(
        7.0, [WIDTH / 2, HEIGHT / 2], camera((0.1, 0.05, 0.1), 0.05).world_from_camera
    ),
}
CALLS = {
    "warp": lambda image, depth, *eyes: warp(image, depth, *eyes)[0],
    "blend": lambda image, depth, source, target: blend(
        [image] * 2, [depth] * 2, [source] * 2, target
    )[0],
    "choose": lambda image, depth, source, target: (
        choose([depth] * 2, [source] * 2, target, count=2).worth
    ),
}


def derivatives(function):
    """A program that gives a value, its tangent, its cotangents, and both sides' product."""

    @jax.jit
    def both(arguments, along, weight):
        value, pushed = jax.jvp(function, arguments, along)
        pulled = jax.vjp(function, *arguments)[1](weight)
        sides = jax.tree.leaves(pulled), jax.tree.leaves(along)
        product = sum(jnp.vdot(*pair) for pair in zip(*sides, strict=True))
        return value, pushed, pulled, product - jnp.vdot(weight, pushed)

    return both


def some_like(tree, rng):
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), tree)


def check_finite(both, function, arguments):
    rng = np.random.default_rng(0)
    along = some_like(arguments, rng)
    weight = some_like(jax.eval_shape(function, *arguments), rng)
    value, pushed, pulled, apart = both(arguments, along, weight)
    for path, leaf in jax.tree_util.tree_leaves_with_path((value, pushed, pulled)):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
    assert abs(float(apart)) < 1e-5
    return along, pushed


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("kind", ["pinhole", "orthographic"])
@pytest.mark.full
def test_no_hole_makes_a_derivative_not_finite(call, kind):
    """In every argument, in both modes: also of a target that is the source."""
    both = derivatives(CALLS[call])
    for name, target in TARGETS.items():
        if (name == "orthographic") != (kind == "orthographic"):
            continue
        for hole in (*MISSING, np.inf, 1e-6, 1e37):
            for place in ("one", "block", "all but one"):
                arguments = (*with_hole(hole, place), camera(), target)
                check_finite(both, CALLS[call], arguments)


@first("hole", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.full
def test_derivatives_beside_a_hole_are_the_difference_quotients(hole):
    function = CALLS["warp"]
    arguments = (*with_hole(hole, "block"), camera(), TARGETS["moved"])
    along, pushed = check_finite(derivatives(function), function, arguments)
    known = jnp.isfinite(arguments[1]) & (arguments[1] > 0)
    along = (
        jnp.where(jnp.isnan(arguments[0]), 0, along[0]),
        jnp.where(known, along[1], 0),
        *along[2:],
    )
    step = jax.jit(lambda s: function(*jax.tree.map(lambda x, v: x + s * v, arguments, along)))
    quotient = (step(1e-7) - step(-1e-7)) / 2e-7
    # Where a pixel passes from one patch to the next, or is lost, the quotient is not it.
    assert np.isclose(pushed, quotient, rtol=1e-4, atol=1e-4).mean() > 0.95


@first("surface", ["texel", "bilinear"])
@first("method", ["pyramid", "linear"])
def test_a_miss_makes_no_derivative_of_a_search_infinite(surface, method):
    search = lambda depth, origin, direction: (
        intersect(depth, origin, direction, surface=surface, search=method).position
    )
    both = derivatives(search)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    origin = np.stack([x, y, 0 * x], axis=-1)
    for hole in (0.0, np.nan, np.inf):
        depth = with_hole(hole, "block")[1] / 4
        for ray in ([1.3, -0.7, 0.4], [0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0], [0, 0, 0]):
            direction = np.broadcast_to(np.array(ray, float), origin.shape)
            rays = jnp.asarray(origin), jnp.asarray(direction)
            check_finite(both, search, (depth, *rays))
