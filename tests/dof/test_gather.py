"""Gather against a plain loop over pixels and taps."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxfx import FocusPlanes, ThinLens, dof
from jaxfx.dof._discs import vogel
from jaxfx.dof.gather import low_resolution
from tests.helpers.forms import first
from tests.test_transforms import CASES


# Of the paper, once more: these are what it prints.
POISSON = [
    (0.0, 0.0),
    (0.527837, -0.085868),
    (-0.040088, 0.536087),
    (-0.670445, -0.179949),
    (-0.419418, -0.616039),
    (0.440453, -0.639399),
    (-0.757088, 0.349334),
    (0.574619, 0.685879),
]
MAX_COC = 12.0
PLANES = FocusPlanes(1.0, 3.0, 8.0, MAX_COC)


def scene(seed=0, height=13, width=18):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.8, 10.0, (height, width))
    depth[rng.random((height, width)) < 0.2] = np.inf
    return rng.random((height, width, 3)), depth


def read(image, x, y):
    """Bilinear, pixel centres at +0.5, the frame repeated."""
    at = [np.atleast_1d(y) - 0.5, np.atleast_1d(x) - 0.5]
    channels = np.moveaxis(np.atleast_3d(image), -1, 0)
    return np.array(
        [ndimage.map_coordinates(c, at, order=1, mode="nearest")[0] for c in channels]
    )


def quarter(image):
    """Four bilinear taps at the inner corners of each 4x4 block, then [1 2 1] both ways."""
    height, width, _ = image.shape
    low = np.empty((-(-height // 4), -(-width // 4), image.shape[2]))
    for j, i in np.ndindex(*low.shape[:2]):
        taps = [(4 * i + dx, 4 * j + dy) for dx in (1, 3) for dy in (1, 3)]
        low[j, i] = np.mean([read(image, *tap) for tap in taps], axis=0)
    kernel = np.outer([1, 2, 1], [1, 2, 1])[:, :, None] / 16
    return ndimage.convolve(low, kernel, mode="nearest")


def loop(image, depth, lens, taps, ramp):
    defocus = np.asarray(lens.defocus(jnp.asarray(depth)))
    defocus = np.clip(defocus, -MAX_COC, MAX_COC)
    low, result = quarter(image), np.empty_like(image)
    for j, i in np.ndindex(*depth.shape):
        centre, total, weights = defocus[j, i], 0, 0
        for x, y in taps:
            dx, dy = x * abs(centre) / 2, y * abs(centre) / 2
            at = i + 0.5 + dx, j + 0.5 + dy
            tap = read(defocus, *at)[0]
            blur = abs(tap) / MAX_COC
            color = (1 - blur) * read(image, *at)
            color = color + blur * read(low, (i + 0.5) / 4 + 0.4 * dx, (j + 0.5) / 4 + 0.4 * dy)
            if ramp:
                behind = np.clip(1 - (centre - tap) / ramp, 0, 1)
            else:
                behind = float(tap >= centre - 1e-13)
            weight = behind + (1 - behind) * blur
            total, weights = total + weight * color, weights + weight
        result[j, i] = total / weights
    return result


@first(("taps", "ramp"), [(None, 0.0), (None, 1.5), (19, 1.5)], 2)
@pytest.mark.parametrize("lens", [ThinLens(0.3, 3.0, 60.0), PLANES], ids=["thin", "planes"])
def test_equals_the_loop(taps, ramp, lens):
    image, depth = scene()
    points = POISSON if taps is None else vogel(taps)
    result = dof.gather(image, depth, lens, max_coc=MAX_COC, taps=taps, ramp=ramp)
    np.testing.assert_allclose(
        result, loop(image, depth, lens, points, ramp), rtol=1e-11, atol=1e-11
    )


def test_the_low_resolution_picture_of_a_frame_of_whole_blocks_is_the_mean_of_each():
    image = np.random.default_rng(0).random((8, 12, 2))
    means = image.reshape(2, 4, 3, 4, 2).mean(axis=(1, 3))
    kernel = np.outer([1, 2, 1], [1, 2, 1])[:, :, None] / 16
    expected = ndimage.convolve(means, kernel, mode="nearest")
    np.testing.assert_allclose(low_resolution(jnp.asarray(image)), expected, atol=1e-14)


@pytest.mark.full
def test_the_derivative_of_a_batch_is_that_of_each_member():
    """At a corner a tap reads its own pixel, from which it differs by rounding alone."""
    members = [CASES["dof.gather"].split(seed=seed, size=(9, 7)) for seed in range(8)]
    call = members[0][0]

    def slopes(arguments):
        out, pull = jax.vjp(call, arguments)
        return out, pull(out)

    stacked = lambda trees: jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
    batch = stacked([arguments for _, arguments in members])
    loop = stacked(list(map(jax.jit(slopes), [arguments for _, arguments in members])))
    found = jax.jit(jax.vmap(slopes))(batch)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(loop), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_a_sharp_foreground_does_not_leak_and_a_blurred_one_has_a_hard_rim():
    image = np.where(np.arange(40) < 20, 1.0, 0.0)[None, :, None] * np.ones((40, 40, 1))
    depth = np.where(np.arange(40) < 20, 1.0, 2.0)[None, :] * np.ones((40, 40))
    sharp = dof.gather(image, depth, ThinLens(1.0, 1.0, 24.0), max_coc=12.0)
    assert sharp[20, :20].min() == 1  # nothing is read from beyond its own pixel
    rim = dof.gather(image, depth, ThinLens(1.0, 2.0, 24.0), max_coc=12.0)
    assert rim[20, 20:].max() == 0  # where the lens sees up to half of the foreground


def test_a_bad_pixel_spoils_what_reads_it():
    image, depth = scene(1, 48, 48)
    depth[:] = np.inf
    for bad_image, bad_depth in ((np.nan, np.inf), (np.inf, np.inf)):
        image[24, 24], depth[24, 24] = bad_image, bad_depth
        call = jax.jit(lambda *a: dof.gather(*a, ThinLens(1.0, 1.0, MAX_COC), max_coc=MAX_COC))
        row, column = np.nonzero(np.isnan(call(image, depth)).any(axis=-1))
        distance = np.maximum(abs(row - 24), abs(column - 24))
        assert 0 in distance
        assert distance.max() <= 0.8 * MAX_COC + 10


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"taps": 0}, "taps"),
        ({"taps": 2.5}, "taps"),
        ({"ramp": -1.0}, "ramp"),
        ({"max_coc": 0}, "max_coc"),
    ],
)
def test_wrong_options_are_named(options, name):
    image, depth = scene()
    with pytest.raises(ValueError, match=rf"`gather\({name}=...\)` must be"):
        inspect.unwrap(dof.gather)(image, depth, PLANES, **options)
