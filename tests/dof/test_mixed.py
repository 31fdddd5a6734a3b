"""Split pixels against a loop in NumPy, and closed forms of antialiased edges and wires."""

import functools as ft
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof import mixed
from tests.dof.test_layered import FOCUS, LENS, NEAR, SIZE, texture


MOST = 12.0
FRONT, BACK = np.array([1.0, 0.5, 0.1]), np.array([0.1, 0.3, 0.8])


@jax.jit
def split(image, depth, lens=LENS):
    return mixed.split(jnp.asarray(image), jnp.asarray(depth), lens, jnp.asarray(2.0), MOST)


def covered(left, right, size=SIZE):
    """The part of each pixel between two columns; the depth of its middle."""
    x = np.arange(size[1])
    share = np.clip(np.minimum(right, x + 1) - np.maximum(left, x), 0, 1)
    is_near = (x + 0.5 > left) & (x + 0.5 < right)
    return np.broadcast_to(share, size), np.broadcast_to(is_near, size)


def smooth(left, right, front=FRONT, back=BACK, near=NEAR, far=FOCUS):
    """An antialiased image of a bar between two columns, its depth, and the shares."""
    share, is_near = covered(left, right)
    image = share[..., None] * front + (1 - share[..., None]) * back
    return image, np.where(is_near, near, far), share


def in_a_loop(image, defocus):
    """Which pixels are mixed, the share of the nearer surface, both colours; pixel by pixel."""
    height, width = defocus.shape
    shares, fronts, backs = np.ones((height, width)), image.copy(), np.zeros_like(image)
    is_mixed = np.zeros((height, width), bool)

    def around(y, x, reach):
        for v in range(max(y - reach, 0), min(y + reach + 1, height)):
            for u in range(max(x - reach, 0), min(x + reach + 1, width)):
                if (v, u) != (y, x) and np.isfinite(defocus[v, u]):
                    yield v, u

    def lone(y, x, sign):
        others = [sign * (defocus[p] - defocus[y, x]) > 2 for p in around(y, x, 1)]
        return 0.2 ** sum(others)

    for y in range(height):
        for x in range(width):
            if not np.isfinite(defocus[y, x]):
                continue
            near = [defocus[p] for p in around(y, x, 1)] + [defocus[y, x]]
            first = min(near)
            is_behind = defocus[y, x] - first > 2
            if not (is_behind or max(near) - defocus[y, x] > 2):
                continue
            found = {"front": [], "back": []}
            for v, u in around(y, x, 2):
                closeness = 1 / (0.5 + (v - y) ** 2 + (u - x) ** 2)
                if defocus[v, u] - first <= 2:
                    found["front"].append((closeness * lone(v, u, 1), image[v, u]))
                elif not is_behind or abs(defocus[v, u] - defocus[y, x]) <= 2:
                    found["back"].append((closeness * lone(v, u, -1), image[v, u]))
            if not (found["front"] and found["back"]):
                continue
            mean, spread = {}, {}
            for side, pixels in found.items():
                weights, colors = map(np.array, zip(*pixels, strict=True))
                weights = weights / weights.sum()
                mean[side] = weights @ colors
                spread[side] = weights @ ((colors - mean[side]) ** 2).sum(axis=-1)
            front, back, own = mean["front"], mean["back"], image[y, x]
            across = front - back
            brightness = (front**2).sum() + (back**2).sum()
            contrast = across @ across
            if contrast <= 1e-6 * brightness:
                continue
            start, side = (back, "back") if is_behind else (front, "front")
            toward = across if is_behind else -across
            lacking = (own - start) @ toward / contrast
            explained = lacking**2 * contrast
            lacking = np.clip(lacking, 0, 0.5)
            lacking *= explained / (explained + spread[side] + 1e-6 * brightness)
            if lacking <= 0:
                continue
            share = lacking if is_behind else 1 - lacking
            rest = (own - share * front - (1 - share) * back) / (share**2 + (1 - share) ** 2)
            is_mixed[y, x], shares[y, x] = True, share
            fronts[y, x], backs[y, x] = front + share * rest, back + (1 - share) * rest
    return is_mixed, shares, fronts, backs


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_over_pixels_splits_the_same(seed):
    rng = np.random.default_rng(seed)
    y, x = np.indices((15, 18))
    defocus, image = np.full(y.shape, 6.0), rng.uniform(0.3, 0.5, (*y.shape, 3))
    for _ in range(4):
        angle, middle = rng.uniform(0, np.pi), rng.uniform(4, 12, 2)
        away = (y - middle[0]) * np.cos(angle) + (x - middle[1]) * np.sin(angle)
        is_near = np.abs(away) < rng.uniform(0.4, 3)
        defocus = np.where(is_near, rng.uniform(-9, 5), defocus)
        image[is_near] = rng.uniform(0, 1, 3) + rng.uniform(-0.1, 0.1, (is_near.sum(), 3))
    depth = 24 / (12 - defocus)
    depth[7, 9], defocus[7, 9] = np.nan, np.nan
    found = split(image, depth)
    is_mixed, shares, fronts, backs = in_a_loop(image, defocus)
    assert is_mixed.sum() > 20
    assert np.array_equal(found.is_mixed, is_mixed)
    np.testing.assert_allclose(found.alpha, shares, atol=1e-9)
    np.testing.assert_allclose(found.image, fronts, atol=1e-9)
    np.testing.assert_allclose(found.behind, backs, atol=1e-9)


@pytest.mark.parametrize("edge", [30.2, 30.5, 30.8])
def test_the_share_of_an_edge_is_found(edge):
    """Both where the edge leaves the pixel's middle, and where it covers it.

    To two hundredths: the mixed pixels above and below have a small share in the colours.
    """
    image, depth, share = smooth(-1.0, edge)
    found = split(image, depth)
    assert np.abs(np.asarray(found.alpha)[:, 30] - share[:, 30]).max() < 0.02
    assert np.array_equal(found.is_mixed, (share > 0) & (share < 1))
    assert np.abs(np.asarray(found.image)[:, 30] - FRONT).max() < 0.02
    assert np.abs(np.asarray(found.behind)[:, 30] - BACK).max() < 0.02
    assert np.array_equal(found.depth, np.where(share > 0, NEAR, FOCUS))
    assert np.array_equal(found.farther, np.where(found.is_mixed, FOCUS, 0))


def test_a_pixel_is_the_sum_of_its_surfaces():
    image, depth, _ = smooth(20.3, 30.7, texture(1), texture(2))
    found = split(image, depth)
    share = np.asarray(found.alpha)[..., None]
    assert 10 < np.sum(found.is_mixed) < image.shape[0] * 4
    np.testing.assert_allclose(share * found.image + (1 - share) * found.behind, image)
    kept = ~np.asarray(found.is_mixed)
    assert np.array_equal(np.asarray(found.image)[kept], image[kept])


def test_what_is_not_antialiased_is_kept():
    _, depth, _ = smooth(20.3, 30.7)
    image = np.where((depth == NEAR)[..., None], FRONT, BACK)
    assert not np.any(split(image, depth).is_mixed)
    flat = np.full_like(image, 0.5)
    assert not np.any(split(flat, depth).is_mixed)


def test_a_steep_surface_is_not_split():
    """Its defocus changes by up to two pixels a pixel."""
    depth = 24 / (12 - np.clip(1.9 * (np.arange(SIZE[1]) - 32), -11, 11.9))
    assert not np.any(split(texture(8), np.broadcast_to(depth, SIZE)).is_mixed)


def passed(left, right, radius, size=SIZE):
    """The part of the lens that a bar between two columns covers, of each pixel's middle."""
    edges = np.array([left, right])[:, None]
    t = np.clip((edges - np.arange(size[1]) - 0.5) / radius, -1, 1)
    parts = (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi
    return np.broadcast_to((parts[1] - parts[0])[:, None], (*size, 1))


@ft.partial(jax.jit, static_argnames="option")
def blur(image, depth, option):
    return dof.layered(image, depth, LENS, max_coc=MOST, mixed=option)


# Of each a rim lies in pixels whose middle it does not cover.
bars = [(30.3, 31.3), (28.6, 31.1)]


@pytest.mark.parametrize(("left", "right"), bars)
def test_a_blurred_bar_is_as_wide_as_it_is(left, right):
    """Before a wall in focus: it covers the lens by its width, which pixels do not have."""
    image, depth, _ = smooth(left, right)
    error = {}
    share = passed(left, right, 6.0)
    exact = share * FRONT + (1 - share) * BACK
    for option in ("keep", "split"):
        error[option] = np.abs(blur(image, depth, option) - exact).max()
    assert error["split"] < 0.01
    assert error["keep"] > 0.2


@pytest.mark.parametrize(("left", "right"), bars)
def test_a_bar_in_focus_shows_no_outline(left, right):
    """Before a flat wall out of focus: the antialiased image itself."""
    image, depth, _ = smooth(left, right, near=FOCUS, far=1e9)
    out = blur(image, depth, "split")
    assert np.abs(out - image).max() < 0.01
    assert np.abs(blur(image, depth, "keep") - image).max() > 0.2


def test_an_edge_before_the_empty_background():
    """Its depth is inf, which in a layer behind would say that nothing is there."""
    image, depth, _ = smooth(-1.0, 30.4, near=FOCUS, far=np.inf)
    out = blur(image, depth, "split")
    assert np.abs(out - image).max() < 0.01
    assert np.abs(blur(image, depth, "keep") - image).max() > 0.2
    assert np.isfinite(split(image, depth).farther).all()


def moving(dtype, function):
    """Of an antialiased bar whose colours and depths move along a random way; and a lens."""
    image, depth, _ = smooth(28.3, 31.2, texture(3), texture(4) + BACK)
    rng = np.random.default_rng(5)
    way, deeper = rng.normal(size=image.shape), 1e-2 * rng.normal(size=depth.shape)

    def moved(step, aperture):
        lens = ThinLens(aperture, jnp.asarray(2.0, dtype), jnp.asarray(24.0, dtype))
        return function(
            jnp.asarray(image + step * way), jnp.asarray(depth + step * deeper), lens
        )

    return moved, (jnp.asarray(0.0, dtype), jnp.asarray(1.1, dtype))


def quotients(moved, at):
    """The derivatives forward and in reverse, and the difference quotients."""
    forward = jax.jit(lambda *at: [jax.jvp(lambda x: moved(x, at[1]), at[:1], (1.0,))[1]])(*at)
    both = jax.jit(jax.value_and_grad(moved, (0, 1)))
    step = 1e-6
    quotient = [
        (both(at[0] + step, at[1])[0] - both(at[0] - step, at[1])[0]) / (2 * step),
        (both(at[0], at[1] + step)[0] - both(at[0], at[1] - step)[0]) / (2 * step),
    ]
    return forward[0], both(*at)[1], quotient


@pytest.mark.full
def test_the_derivative_of_split_pixels_is_the_difference_quotient():
    weights = np.random.default_rng(6).normal(size=(4, *SIZE))

    def total(image, depth, lens):
        found = mixed.split(image, depth, lens, jnp.asarray(2.0), 16.0)
        planes = found.alpha, found.depth, found.image[..., 0], found.behind[..., 1]
        return sum(jnp.sum(x * w) for x, w in zip(planes, weights, strict=True))

    forward, reverse, quotient = quotients(*moving(jnp.float64, total))
    np.testing.assert_allclose(forward, reverse[0], rtol=1e-9)
    np.testing.assert_allclose(reverse[0], quotient[0], rtol=1e-5)
    # Which pixels those are is all that the lens decides.
    assert reverse[1] == 0


@pytest.mark.full
def test_the_derivative_of_the_blurred_image_is_the_difference_quotient():
    weights = np.random.default_rng(6).normal(size=(*SIZE, 3))

    def total(image, depth, lens):
        return jnp.sum(weights * dof.layered(image, depth, lens, max_coc=16.0, mixed="split"))

    forward, reverse, quotient = quotients(*moving(jnp.float64, total))
    np.testing.assert_allclose(forward, reverse[0], rtol=1e-9)
    np.testing.assert_allclose(reverse, quotient, rtol=1e-4)


def test_float32_is_close_to_float64():
    image, depth, _ = smooth(20.3, 30.7, texture(1), texture(2))
    short = split(image.astype(np.float32), depth.astype(np.float32))
    assert short.image.dtype == short.alpha.dtype == short.farther.dtype == jnp.float32
    for one, other in zip(short, split(image, depth), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


@pytest.mark.full
def test_a_batch_is_its_images():
    pairs = [smooth(left, right, texture(6))[:2] for left, right in bars]
    images, depths = map(np.stack, zip(*pairs, strict=True))
    batch = jax.vmap(split)(images, depths)
    for index, pair in enumerate(pairs):
        for one, many in zip(split(*pair), batch, strict=True):
            np.testing.assert_allclose(many[index], one, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 3), (4, 1)])
def test_any_size(size):
    rng = np.random.default_rng(7)
    image, depth = rng.random((*size, 3)), rng.choice([NEAR, FOCUS, np.inf], size)
    found = split(image, depth)
    assert found.image.shape == image.shape
    assert np.isfinite(found.image).all() and np.isfinite(found.alpha).all()


def test_faults_are_named():
    layered = inspect.unwrap(dof.layered)
    image, depth = texture(), np.full(SIZE, 2.0)
    with pytest.raises(ValueError, match=r"layered\(mixed=...\)` must be"):
        layered(image, depth, LENS, mixed="both")
    with pytest.raises(ValueError, match=r"layered\(alpha=...\)` must be left out"):
        layered(image, depth, LENS, mixed="split", alpha=np.ones(SIZE))
