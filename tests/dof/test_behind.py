"""Several layers, alpha, and a margin, against passes through a lens.

The reference composites planes for each point of the lens: a plane of defocus d is moved by
half of d times the point, which is exact for planes that face the camera.
"""

import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof.accumulate import lens_samples
from tests.dof.test_layered import FAR, FOCUS, LENS, NEAR, SIZE, texture
from tests.helpers.quick import check_slopes


# Depths at which LENS has a defocus of -4 and -6 pixels.
MIDDLE, HALF = 1.5, 4 / 3
COLUMN = np.arange(SIZE[1])


def passes(planes, samples=512):
    """The mean over a lens of planes (image, alpha, defocus), front to back: one row of it.

    A plane is read between its pixels, along a row: each is the same in all rows.
    """
    size = len(planes[0][1])
    x = np.arange(size, dtype=float)
    total = np.zeros((size, 3))
    for u in 2 * lens_samples(samples)[0][:, 0]:
        left = np.ones((size, 1))
        for image, alpha, defocus in planes:
            at = x - u * defocus / 2
            read = lambda row, at=at: np.interp(at, x, row)
            color = np.stack([read(alpha * image[:, c]) for c in range(3)], axis=-1)
            total += left * color
            left = left * (1 - read(alpha)[:, None])
    return total / samples


def wide(row):
    """A row, repeated to an image."""
    return np.broadcast_to(row[None], (SIZE[0], *row.shape))


def waves(seed):
    """A row of smooth colours, which reading between pixels keeps."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.1, 0.3, 3) * COLUMN[:, None] + rng.uniform(0, 6, 3)
    return 0.5 + 0.4 * np.sin(turn)


def layered(image, depth, behind, alpha=None, lens=LENS):
    return dof.layered(image, depth, lens, max_coc=12.0, behind=behind, alpha=alpha)


def test_a_third_layer_shows_past_the_second():
    """A near plane before a middle one that ends just behind its edge, before a wall."""
    near, middle, wall = (waves(seed) for seed in (1, 2, 3))
    is_near, is_middle = COLUMN < 30, COLUMN < 26
    image = wide(np.where(is_near[:, None], near, wall))
    depth = wide(np.where(is_near, NEAR, FOCUS))
    second = (
        wide(np.where(is_middle[:, None], middle, wall)),
        wide(np.where(is_middle, MIDDLE, np.where(is_near, FOCUS, np.inf))),
    )
    third = wide(wall), wide(np.where(is_middle, FOCUS, np.inf))
    planes = [
        (near, 1.0 * is_near, -12),
        (middle, 1.0 * is_middle, -4),
        (wall, 1 + 0 * near[:, 0], 0),
    ]
    exact = passes(planes)
    error = lambda behind: np.abs(layered(image, depth, behind)[12] - exact)[8:-8].max()
    assert error([second, third, None]) < 0.006
    assert error([second, "peel"]) < 0.01
    assert error(second) == error([second]) == error([second, "peel"])
    assert error([second, None]) > 0.03
    assert error([None]) == error(None)


@pytest.mark.parametrize("lens", [LENS, ThinLens(0.0, 2.0, 24.0)])
def test_alpha_in_focus_is_plain_over(lens):
    """Of straight colours; with a lens in focus, and with a closed one at any depth."""
    rng = np.random.default_rng(0)
    image, wall, alpha = texture(1), texture(2), rng.uniform(0, 1, SIZE)
    alpha[:4], alpha[4:8] = 0, 1
    depth = np.full(SIZE, FOCUS) if lens is LENS else rng.uniform(1, 2, SIZE)
    behind = wall, np.full(SIZE, FOCUS) if lens is LENS else np.full(SIZE, 3.0)
    exact = alpha[..., None] * image + (1 - alpha[..., None]) * wall
    assert np.abs(layered(image, depth, behind, alpha, lens) - exact).max() < 1e-9


@pytest.mark.parametrize(
    ("near", "far", "most"),
    [
        *[(NEAR, FOCUS, 0.002), (HALF, FOCUS, 0.002), (FOCUS, 4.0, 0.01), (FOCUS, FAR, 0.02)],
        # Which part of the lens the matte leaves free is not known to the wall.
        *[(HALF, 4.0, 0.02), (NEAR, 4.0, 0.03), (HALF, FAR, 0.04), (NEAR, FAR, 0.06)],
    ],
)
@pytest.mark.full
def test_a_soft_matte_is_what_passes_show(near, far, most):
    """A matte that fades over 16 pixels, before a wall; either may be in focus."""
    front, wall = waves(4), waves(5)
    matte = np.clip((40 - COLUMN) / 16, 0, 1)
    defocus = lambda depth: 12 * (1 - 2 / depth)
    exact = passes([(front, matte, defocus(near)), (wall, np.ones(SIZE[1]), defocus(far))])
    every = np.ones(SIZE)
    behind = wide(wall), np.full(SIZE, far), every
    out = layered(wide(front), np.full(SIZE, near), behind, wide(matte))
    assert np.abs(out[12] - exact)[8:-8].max() < most


@pytest.mark.full
def test_clear_pixels_may_hold_anything():
    """Neither their colour nor their depth counts."""
    front, wall, matte = waves(6), wide(waves(7)), wide(np.clip((40 - COLUMN) / 8, 0, 1))
    image, depth = np.array(wide(front)), np.full(SIZE, NEAR)
    behind = wall, np.full(SIZE, FOCUS)
    clear = layered(image, depth, behind, matte)
    image[:, 40:50], depth[:, 44:] = np.nan, np.nan
    assert np.abs(layered(image, depth, behind, matte) - clear).max() < 1e-9
    assert np.abs(clear[:, 50:] - wall[:, 50:]).max() < 1e-9


@pytest.mark.full
def test_alpha_of_one_everywhere_is_none():
    image, depth, wall = texture(8), np.random.default_rng(8).uniform(1, 5, SIZE), texture(9)
    behind = wall, depth + 2
    same = layered(image, depth, behind)
    assert np.abs(layered(image, depth, behind, np.ones(SIZE)) - same).max() < 1e-9


SMALL = 7, 9


def small(seed=0) -> tuple:
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0.2, 0.9, SMALL)
    alpha[2, 2:5], alpha[4, 2:5] = 0, 1
    behind: Any = [(rng.random((*SMALL, 3)), rng.uniform(4, 6, SMALL)) for _ in range(2)]
    return rng.random((*SMALL, 3)), rng.uniform(1.2, 3, SMALL), behind, alpha


@jax.jit
def derivatives(image, depth, behind, alpha, dot):
    """Of the sum of squares along `dot`, forward and reverse; the loss."""

    def loss(*data):
        image, depth, behind, alpha = data
        options = {"max_coc": 8.0, "behind": behind, "alpha": alpha}
        return jnp.sum(dof.layered(image, depth, LENS, **options) ** 2)

    data = image, depth, behind, alpha
    forward = jax.jvp(loss, data, dot)
    bar = jax.grad(loss, (0, 1, 2, 3))(*data)
    return *forward, sum(
        jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (bar, dot)), strict=True)
    )


@pytest.mark.full
def test_derivatives_of_all_layers_and_of_alpha_are_the_difference_quotient():
    data = jax.tree.map(jnp.asarray, small())
    rng = np.random.default_rng(1)
    dot = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), data)
    # Where alpha is 0 or 1 it can change only inwards: a quotient of one side.
    alpha = data[3]
    sign = jnp.where(alpha == 0, 1, -1)
    dot = (*dot[:3], jnp.where((alpha == 0) | (alpha == 1), sign * jnp.abs(dot[3]), dot[3]))
    _, forward, reverse = derivatives(*data, dot)
    step = 1e-6
    moved = lambda n: derivatives(*jax.tree.map(lambda x, v: x + n * step * v, data, dot), dot)[
        0
    ]
    quotient = (4 * moved(1) - 3 * moved(0) - moved(2)) / (2 * step)
    assert abs(forward - reverse) < 1e-9 * abs(forward)
    assert abs(forward - quotient) < 1e-4 * abs(quotient)


@pytest.mark.parametrize("margin", [1, 9])
@pytest.mark.full
def test_a_margin_is_left_out_of_the_output(margin):
    """Smaller than the largest sprite, and larger."""
    image, depth, behind, alpha = small(2)
    tall = lambda x: np.repeat(np.repeat(x, 3, axis=0), 3, axis=1)
    image, depth, alpha = map(tall, (image, depth, alpha))
    behind: Any = [tuple(map(tall, layer)) for layer in behind]
    blur = lambda **more: dof.layered(
        image, depth, LENS, max_coc=8.0, behind=behind, alpha=alpha, **more
    )
    inside = blur()[margin:-margin, margin:-margin]
    assert np.abs(blur(margin=margin) - inside).max() < 1e-9


@pytest.mark.full
def test_rgba_and_disparity_before_a_background_and_its_disparity():
    """As matting tools have it: straight colours and alpha, blur strength, focus disparity."""
    front, wall = waves(9), waves(10)
    matte = np.clip((40 - COLUMN) / 16, 0, 1)
    rgba = wide(np.concatenate([front, matte[:, None]], axis=1))
    disparity, behind = np.full(SIZE, 0.9), np.full(SIZE, 0.4)
    lens = ThinLens.from_disparity(strength=20.0, focus_disparity=0.9)
    exact = passes([(front, matte, 0), (wall, np.ones(SIZE[1]), 20 * (0.9 - 0.4))])
    found = dof.layered(
        rgba[..., :3],
        1 / disparity,
        lens,
        max_coc=12.0,
        alpha=rgba[..., 3],
        behind=(wide(wall), 1 / behind),
    )
    # As of any soft matte in focus before a wall out of focus.
    assert np.abs(found[12] - exact)[8:-8].max() < 0.02
    # All four as colours: each is what it is by itself, and nothing shows through.
    four = dof.layered(rgba, 1 / disparity, lens, max_coc=12.0)
    np.testing.assert_allclose(four, rgba, atol=1e-12)


@pytest.mark.parametrize(("pad", "mode"), [("repeat", "edge"), ("reflect", "symmetric")])
def test_what_lies_beyond_the_frame_is_what_passes_show(pad, mode):
    """Two planes side by side, both out of focus: the first and the last columns."""
    image, matte = waves(6), 1.0 * (COLUMN < 30)
    wider = lambda row: np.pad(row, [(8, 8)] + [(0, 0)] * (row.ndim - 1), mode=mode)
    near, wall = wider(image), wider(waves(7))
    # The passes read beyond the row's ends too: pads are wider than the largest radius.
    planes = [(near, wider(matte), -12), (wall, np.ones(len(wall)), 4)]
    exact = passes(planes)[8:-8]
    depth = wide(np.where(COLUMN < 30, NEAR, 3.0))
    front = wide(np.where(COLUMN[:, None] < 30, image, waves(7)))
    behind = wide(waves(7)), wide(np.where(COLUMN < 30, 3.0, np.inf))
    found = dof.layered(front, depth, LENS, max_coc=12.0, behind=behind, pad=pad)[12]
    ends = np.r_[:8, -8:0]
    assert np.abs(found - exact)[ends].max() < 0.015
    other = {"repeat": "reflect", "reflect": "repeat"}[pad]
    wrong = dof.layered(front, depth, LENS, max_coc=12.0, behind=behind, pad=other)[12]
    assert np.abs(wrong - exact)[ends].max() > 0.04


@pytest.mark.parametrize("margin", [0, 2])
@pytest.mark.full
def test_a_mirror_image_is_that_of_arrays_that_are_mirrored(margin):
    """All layers, alpha, and a lens with circles of its own; an image smaller than a sprite."""
    image, depth, behind, alpha = small(3)

    class Other:
        focus_distance = LENS.focus_distance
        defocus = staticmethod(LENS.defocus)
        circle_of_confusion = staticmethod(LENS.circle_of_confusion)

    mirrored = lambda x: np.pad(x, [(9, 9)] * 2 + [(0, 0)] * (x.ndim - 2), mode="symmetric")
    options = {"max_coc": 14.0, "lens": Other()}
    found = dof.layered(
        image, depth, alpha=alpha, behind=behind, margin=margin, pad="reflect", **options
    )
    expected = dof.layered(
        mirrored(image),
        mirrored(depth),
        alpha=mirrored(alpha),
        behind=[tuple(map(mirrored, layer)) for layer in behind],
        margin=9 + margin,
        **options,
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.full
def test_slopes_of_a_mirror_image_are_the_difference_quotient():
    image, depth, behind, alpha = small(4)
    weight = np.random.default_rng(5).random(image.shape)

    def loss(image, depth, aperture):
        lens = ThinLens(aperture, LENS.focus_distance, LENS.focal_pixels)
        options = {"max_coc": 8.0, "behind": behind, "alpha": alpha, "pad": "reflect"}
        return jnp.sum(weight * dof.layered(image, depth, lens, **options))

    operands = jnp.asarray(image), jnp.asarray(depth), LENS.aperture
    check_slopes(loss, operands, atol=1e-5, rtol=1e-5, eps=1e-6)


def test_a_margin_of_scatter_is_what_passes_show():
    """A plane out of focus that goes on beyond the frame."""
    row, beyond = waves(8), 10
    exact = passes([(row, np.ones(SIZE[1]), 12)])[beyond:-beyond]
    high = lambda x: np.broadcast_to(x, (SIZE[0] + 20, *x.shape))
    lens = ThinLens(1.0, 2.0, 24.0)
    depth = np.full((SIZE[0] + 20, SIZE[1]), np.inf)
    found = dof.scatter(high(row), depth, lens, max_coc=12.0, margin=beyond)
    assert found.shape == (SIZE[0], SIZE[1] - 2 * beyond, 3)
    assert np.abs(found[12] - exact).max() < 0.002
    inside = lambda x: x[:, beyond:-beyond]
    alone = dof.scatter(inside(high(row)), inside(depth), lens, max_coc=12.0)[22]
    assert np.abs(alone - exact).max() > 0.05


def test_faults_are_named():
    layered = inspect.unwrap(dof.layered)
    image, depth = texture(), np.full(SIZE, 2.0)
    pair = image, depth
    for behind in (
        ("peal",),
        [pair, "wall"],
        [None, pair],
        (*pair, None),
        [pair, (image,)],
        [(pair, pair)],
    ):
        with pytest.raises(ValueError, match=r"`layered\(behind=...\)` must be "):
            layered(image, depth, LENS, behind=behind)
    with pytest.raises(ValueError, match=r"`layered\(alpha=...\)` must be in \[0, 1\]"):
        layered(image, depth, LENS, alpha=2 * depth)
    with pytest.raises(ValueError, match=r"`layered\(alpha=...\)` must have shape"):
        layered(image, depth, LENS, alpha=depth[1:])
    for margin in (-1, 12, 0.5):
        with pytest.raises(ValueError, match=r"`layered\(margin=...\)` must be an integer"):
            layered(image, depth, LENS, margin=margin)
        with pytest.raises(ValueError, match=r"`scatter\(margin=...\)` must be an integer"):
            inspect.unwrap(dof.scatter)(image, depth, LENS, margin=margin)
    with pytest.raises(ValueError, match=r"`layered\(pad=...\)` must be "):
        layered(image, depth, LENS, pad="black")
