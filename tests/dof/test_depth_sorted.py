"""Sprites in order of depth against a plain loop, a closed form and a lens cast ray by ray."""

import functools as ft
import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, dof, metrics
from jaxfx.dof.accumulate import lens_samples


LENSES = [ThinLens(0.1, 2.5, 60.0), FocusPlanes(1.0, 2.5, 6.0, 5.0)]


def row_area(radius, row):
    """Half the disc's area in a row of pixels, by quadrature."""
    t = np.linspace(row - 0.5, row + 0.5, 20001)
    t = (t[1:] + t[:-1]) / 2
    return np.mean(np.sqrt(np.maximum(radius**2 - t**2, 0)))


@ft.lru_cache
def sprite(radius):
    """The share of the lens by which a sprite covers each pixel that it reaches."""
    if radius <= 0.5:  # inside its own pixel
        return {(0, 0): 1.0}
    reach, shares = math.ceil(radius + 1), {}
    for dy in range(-reach, reach + 1):
        half = row_area(radius, dy)
        for dx in range(-reach, reach + 1):
            covered = max(min(dx + 0.5, half) - max(dx - 0.5, -half), 0)
            if covered:
                shares[dy, dx] = covered / (math.pi * radius**2)
    return shares


def arriving(depth, defocus):
    """For every pixel, the sprites that reach it, as (share, row, column)."""
    found = {q: [] for q in np.ndindex(depth.shape)}
    for j, i in np.ndindex(depth.shape):
        for (dy, dx), share in sprite(abs(defocus[j, i]) / 2).items():
            if (j + dy, i + dx) in found:
                found[j + dy, i + dx].append((share, j, i))
    return found


def loop(image, defocus, groups):
    """Front to back, group by group, each in what the nearer ones have left of the lens.

    `groups` gives the groups that a pixel is in and its part in each.
    """
    result = np.empty_like(image)
    for q, sprites in arriving(defocus, defocus).items():
        opacity, colors = {}, {}
        for share, *p in sprites:
            for group, part in filter(lambda one: one[1], groups(*p)):
                opacity[group] = opacity.get(group, 0) + part * share
                colors[group] = colors.get(group, 0) + part * share * image[*p]
        left, total, weight = 1.0, 0, 0
        for group in sorted(opacity):
            visible = min(1, max(left, 0) / opacity[group])
            total, weight = total + visible * colors[group], weight + visible * opacity[group]
            left -= opacity[group]
        result[q] = total / weight
    return result


def random_scene(seed=0, height=8, width=9):
    rng = np.random.default_rng(seed)
    # A few depths, so that many sprites lie at the same one, and the ground far behind.
    depth = rng.choice([1.1, 1.7, 2.5, 4.0, np.inf], (height, width))
    return rng.random((height, width, 2)), depth


def clamped(lens, depth):
    return np.clip(np.asarray(lens.defocus(jnp.asarray(depth))), -5, 5)


@pytest.mark.parametrize("lens", LENSES, ids=["thin", "planes"])
def test_all_slices_equal_the_loop(lens):
    image, depth = random_scene()
    expected = loop(image, clamped(lens, depth), lambda j, i: [(depth[j, i], 1.0)])
    result = dof.depth_sorted(image, depth, lens, max_coc=5, slices="all")
    # The loop's quadrature is good to about 1e-6.
    np.testing.assert_allclose(result, expected, atol=5e-6)


@pytest.mark.parametrize("slices", [1, 6])
def test_slices_equal_the_loop(slices):
    image, depth = random_scene(1)
    defocus = clamped(LENSES[0], depth)

    def groups(j, i):
        place = (defocus[j, i] / 5 + 1) / 2 * (slices - 1)
        first = math.floor(place)
        return [(first, 1 - (place - first)), (first + 1, place - first)]

    expected = loop(image, defocus, groups)
    result = dof.depth_sorted(image, depth, LENSES[0], max_coc=5, slices=slices)
    np.testing.assert_allclose(result, expected, atol=5e-6)


def layers(side, samples=4096):
    """Three flat layers, a strip before a disc before a wall, cut by no other; and the truth.

    Each layer is of one colour and one defocus, so that what is hidden is known; the truth is
    the mean, over points of the lens, of the nearest layer at the pixel's centre.
    """
    colors = np.array([[0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.9]])
    depths, lens = np.array([1.0, 2.0, 4.0]), ThinLens(0.5, 2.0, 40.0)
    defocus = np.asarray(lens.defocus(jnp.asarray(depths)))

    def seen(x, y, shift):
        """The layer seen at (x, y) by the lens point that shifts each layer by `shift`."""
        strip = np.abs(x + shift[0, 0] - 0.3 * side) < 3
        ball = (
            np.hypot(x + shift[1, 0] - 0.6 * side, y + shift[1, 1] - 0.5 * side) < 0.28 * side
        )
        return np.where(strip, 0, np.where(ball, 1, 2))

    y, x = np.mgrid[:side, :side] + 0.5
    first = seen(x, y, np.zeros((3, 2)))
    truth = np.zeros((side, side, 3))
    for point in lens_samples(samples)[0]:
        truth += colors[seen(x, y, defocus[:, None] * point)]
    return colors[first], depths[first], lens, truth / samples


@pytest.mark.full
def test_beats_scatter_on_an_ordered_scene():
    """At any gamma and epsilon; and by far, where nothing that the lens sees is hidden."""
    image, depth, lens, truth = layers(40)
    behind = depth > depth.min()

    def scores(method, **options):
        result = method(image, depth, lens, max_coc=10.0, **options)
        return np.array([metrics.psnr(result, truth), metrics.psnr(result, truth, mask=behind)])

    scatter = [
        scores(dof.scatter, gamma=gamma, epsilon=epsilon)
        for gamma in (0.0, 0.15, 0.3, 0.45, 0.6, 1.0, 2.0)
        for epsilon in (1.0, 4.0)
    ]
    whole, seen = np.max(scatter, axis=0)
    for slices in ("all", 8):
        result = scores(dof.depth_sorted, slices=slices)
        assert result[0] > whole
        assert result[1] > seen + 2
        assert result[1] > 40


@pytest.mark.full
def test_a_blurred_edge_is_as_opaque_as_the_share_of_the_lens_that_it_covers():
    """Exact where scatter, whatever its gamma, is wrong by up to a sixth."""
    radius, columns = 6.0, np.arange(41) + 0.5 - 20
    s = np.clip(columns / radius, -1, 1)
    share = 0.5 - (s * np.sqrt(1 - s * s) + np.arcsin(s)) / np.pi
    image = np.broadcast_to((columns < 0)[None, :, None] * 1.0, (41, 41, 1))
    depth = np.broadcast_to(np.where(columns < 0, 1.0, 2.0)[None], (41, 41))
    lens = ThinLens(1.0, 2.0, 4 * radius)
    for slices in ("all", 8):
        result = dof.depth_sorted(image, depth, lens, max_coc=12.0, slices=slices)
        outside = columns > 0
        np.testing.assert_allclose(result[20, outside, 0], share[outside], atol=0.012)


@pytest.mark.parametrize("slices", [5, "all"])
def test_a_bad_pixel_spoils_what_its_sprite_reaches(slices):
    image, depth = random_scene(2, 24, 24)
    y, x = np.mgrid[:24, :24]
    call = jax.jit(lambda *a: dof.depth_sorted(*a, LENSES[0], max_coc=5, slices=slices))
    depth[12, 12] = 1.1
    for bad_image, bad_depth in ((np.nan, 1.1), (np.inf, 1.1)):
        image[12, 12], depth[12, 12] = bad_image, bad_depth
        spoiled = np.isnan(call(image, depth)).any(axis=-1)
        assert spoiled[12, 12]
        assert np.hypot(y - 12, x - 12)[spoiled].max() <= 2.5 + 1


@pytest.mark.parametrize("slices", [0, 2.5, "some"])
def test_bad_slices_are_named(slices):
    image, depth = random_scene()
    with pytest.raises(ValueError, match=r"`depth_sorted\(slices=...\)` must be a positive"):
        inspect.unwrap(dof.depth_sorted)(image, depth, LENSES[0], slices=slices)
