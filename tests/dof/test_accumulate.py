"""The multi-pass reference against closed forms: what a lens does to an edge or a wave."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from jaxfx import FocusPlanes, PinholeCamera, ThinLens, dof
from jaxfx._sampling import pixel_centers
from jaxfx.dof.accumulate import lens_samples
from tests.helpers.forms import first


HEIGHT, WIDTH = 8, 24
FOCUS = 2.0
CAMERA = PinholeCamera.from_fov(0.8, height=HEIGHT, width=WIDTH)
LENS = ThinLens.from_camera(CAMERA, aperture=1.0, focus_distance=FOCUS)


def plane(depth, radiance):
    """Renders a plane across the axis whose radiance is a function of the world's x and y."""

    def render(camera):
        # Eyes lie in the plane z = 0, so that the plane is at this depth from each of them.
        pixels = pixel_centers(HEIGHT, WIDTH, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full((HEIGHT, WIDTH), depth, pixels.dtype))
        return radiance(points[..., 0], points[..., 1])[..., None]

    return render


def edge(x, y):
    return (x > 0).astype(x.dtype)


def waves(x, y):
    return 1 + jnp.sin(3 * x) * jnp.cos(2 * y)


def blurred_waves(depth):
    """`waves` through the lens: the mean of a plane wave over a disc is a Bessel function."""
    radius = float(LENS.aperture) / 2 * abs(1 - depth / FOCUS)
    phase = math.hypot(3, 2) * radius
    points = CAMERA.unproject(pixel_centers(HEIGHT, WIDTH), jnp.full((HEIGHT, WIDTH), depth))
    image = np.asarray(waves(points[..., 0], points[..., 1]))[..., None]
    return 1 + (image - 1) * 2 * scipy.special.j1(phase) / phase


def accumulate(render, lens=LENS, **options):
    return dof.accumulate(render, CAMERA, lens, **{"progress": False} | options)


def disc_left_of(t):
    """The share of a disc of diameter 1 that lies left of t: a circular segment's area."""
    t = np.clip(2 * t, -1, 1)
    return 0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi


@first("depth", [1.0, 3.0])
@pytest.mark.full
def test_an_edge_becomes_the_area_of_the_disc(depth):
    samples = 256
    result = accumulate(plane(depth, edge), samples=samples, jitter=False).image
    distance = pixel_centers(HEIGHT, WIDTH)[..., 0] - WIDTH / 2
    # A point moves by offset * focal * (1 / focus - 1 / depth) pixels.
    diameter = abs(float(LENS.focal_pixels) * (1 / FOCUS - 1 / depth))
    expected = disc_left_of(distance / diameter)
    np.testing.assert_allclose(result[..., 0], expected, atol=8 / samples)


def test_a_point_moves_by_what_the_lens_formula_says():
    depth, offset = 3.0, np.array([0.3, -0.2])
    eyes = []
    accumulate(lambda eye: eyes.append(eye) or plane(depth, edge)(eye), samples=5, jitter=False)
    offsets, _ = lens_samples(5)
    focal = float(LENS.focal_pixels)
    point = jnp.array([*offset, depth])
    centre, _ = CAMERA.project(point)
    for eye, moved in zip(eyes, offsets, strict=True):
        pixels, seen_depth = eye.project(point)
        expected = centre + moved * focal * (1 / FOCUS - 1 / depth)
        np.testing.assert_allclose(pixels, expected, atol=1e-12)
        np.testing.assert_allclose(seen_depth, depth)


def test_the_focus_plane_stays_as_sharp_as_one_picture():
    render = plane(FOCUS, waves)
    result = accumulate(render, samples=7, jitter=False)
    np.testing.assert_allclose(result.image, render(CAMERA), atol=1e-12)
    assert result.convergence < 1e-12


def test_a_closed_lens_is_a_pinhole():
    lens = ThinLens(0.0, FOCUS, LENS.focal_pixels)
    render = plane(5.0, waves)
    result = accumulate(render, lens, samples=3, jitter=False)
    np.testing.assert_allclose(result.image, render(CAMERA), atol=1e-12)


def test_a_constant_stays_constant():
    result = accumulate(plane(7.0, lambda x, y: jnp.full_like(x, 0.3)), samples=5)
    np.testing.assert_allclose(result.image, 0.3, atol=1e-15)
    assert result.convergence < 1e-15


@pytest.mark.full
def test_jitter_antialiases_by_a_box_of_one_pixel():
    # On the focus plane, an edge that cuts the pixels of column 12 at three quarters.
    focal = float(LENS.focal_pixels)
    shifted = plane(FOCUS, lambda x, y: edge(x - 0.75 * FOCUS / focal, y))
    row = accumulate(shifted, samples=256).image[0, :, 0]
    np.testing.assert_allclose(row[12], 0.25, atol=0.02)
    assert not row[:12].any()
    np.testing.assert_allclose(row[13:], 1)
    assert set(np.unique(accumulate(shifted, samples=8, jitter=False).image)) == {0, 1}


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.full
def test_one_bad_pixel_spoils_neither_the_convergence_nor_a_derivative(bad):
    good = plane(3.0, waves)
    clear = np.ones((HEIGHT, WIDTH, 1), bool)
    clear[2, 5] = False
    spoiled = lambda camera: jnp.where(clear, good(camera), bad)
    whole, without = accumulate(spoiled, samples=4), accumulate(good, samples=4)
    np.testing.assert_array_equal(np.isfinite(whole.image), clear)
    half = accumulate(good, samples=2).image
    expected = np.sqrt(np.mean(np.asarray(half - without.image)[clear] ** 2))
    np.testing.assert_allclose(whole.convergence, expected, rtol=1e-9)

    def convergence(lens):
        return accumulate(spoiled, lens, samples=4).convergence

    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(jax.grad(convergence)(LENS)))
    nowhere = accumulate(lambda camera: 0 * good(camera) + np.nan, samples=4)
    assert np.isnan(nowhere.convergence)


@pytest.mark.full
def test_convergence_is_that_of_half_the_passes_and_tells_the_error():
    render = plane(5.0, waves)
    truth = blurred_waves(5.0)
    figures, errors = [], []
    for samples in (4, 32, 256):
        whole = accumulate(render, samples=samples, jitter=False)
        half = accumulate(render, samples=samples // 2, jitter=False).image
        expected = np.sqrt(np.mean((np.asarray(whole.image) - np.asarray(half)) ** 2))
        np.testing.assert_allclose(whole.convergence, expected, rtol=1e-9)
        figures.append(float(whole.convergence))
        errors.append(float(np.sqrt(np.mean((np.asarray(whole.image) - truth) ** 2))))
    assert figures == sorted(figures, reverse=True)
    # Faster than at random, where 64 times the passes are 8 times better.
    assert errors[-1] < errors[0] / 16
    np.testing.assert_allclose(np.log(figures), np.log(errors), atol=np.log(10))
    assert np.isnan(accumulate(render, samples=1).convergence)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("samples", [32, 48, 64, 96, 100, 128, 200, 256, 400, 1000])
def test_every_prefix_of_the_samples_covers_the_disc_evenly(samples, seed):
    everything, shifts = lens_samples(1024, seed)
    offsets, _ = lens_samples(samples, seed)
    np.testing.assert_array_equal(offsets, everything[:samples])
    assert (np.hypot(*offsets.T) <= 0.5).all()
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=1 / samples)
    # The second moment of a disc of radius R is R**2 / 2. An aperture that is off by a share
    # shows here as twice that share: a mean of 128 passes is to be right to 0.2 % of it.
    moments = offsets.T @ offsets / samples
    np.testing.assert_allclose(np.trace(moments), 1 / 8, rtol=0.5 / samples + 0.002)
    np.testing.assert_allclose(moments, np.eye(2) / 16, atol=0.4 / samples)
    np.testing.assert_allclose(shifts[:samples].mean(axis=0), 0, atol=1 / samples)
    np.testing.assert_allclose((shifts[:samples] ** 2).mean(axis=0), 1 / 12, atol=1 / samples)
    assert (np.abs(shifts) <= 0.5).all()


def test_seeds_differ_and_repeat():
    one, again, other = (
        accumulate(plane(5.0, waves), samples=4, seed=seed).image for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1e-4


@pytest.mark.full
def test_gradients_pass_through_the_renderer_in_both_modes():
    render = plane(5.0, waves)
    weight = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 1))

    def score(aperture, focus):
        lens = ThinLens(aperture, focus, LENS.focal_pixels)
        return jnp.vdot(weight, accumulate(render, lens, samples=6).image)

    at, step = (jnp.asarray(0.7), jnp.asarray(2.5)), 1e-6
    forward = jax.jacfwd(score, argnums=(0, 1))(*at)
    reverse = jax.grad(score, argnums=(0, 1))(*at)
    for i in range(2):
        ahead, behind = (
            score(*(x + sign * step * (i == j) for j, x in enumerate(at))) for sign in (1, -1)
        )
        np.testing.assert_allclose(forward[i], (ahead - behind) / (2 * step), rtol=1e-6)
        np.testing.assert_allclose(reverse[i], forward[i], rtol=1e-10)
    assert all(math.isfinite(value) and value != 0 for value in reverse)


def test_faults_name_the_argument():
    call = inspect.unwrap(dof.accumulate)
    render = plane(5.0, waves)
    for samples in (0, -1, 2.0):
        with pytest.raises(ValueError, match=r"`accumulate\(samples=\.\.\.\)` must be a pos"):
            call(render, CAMERA, LENS, samples=samples, progress=False)
    planes = FocusPlanes(1.0, 2.0, 3.0, 4.0)
    with pytest.raises(ValueError, match=r"`accumulate\(lens\)` must be a ThinLens, got Focus"):
        call(render, CAMERA, planes, samples=2, progress=False)
    sizes = iter([(4, 4, 1), (4, 5, 1)])
    with pytest.raises(ValueError, match=r"one shape, got \(4, 4, 1\), then \(4, 5, 1\)"):
        call(lambda eye: jnp.zeros(next(sizes)), CAMERA, LENS, samples=2, progress=False)


@first(
    ("kind", "value", "result"),
    [
        (np.uint8, 200, np.float64),
        (np.uint16, 60000, np.float64),
        (np.float16, 400, np.float16),
        (">f4", 0.3, np.float32),
        (np.float32, 0.1, np.float32),
    ],
)
@pytest.mark.full
def test_pictures_of_other_types_are_summed_as_floats(kind, value, result):
    """256 of them: their sum is beyond what bytes and halves hold."""
    picture = np.full((2, 2, 3), value, kind)
    rounding = float(256 * np.finfo(np.float32).eps)  # of a sum of so many
    found = accumulate(lambda _: picture, samples=256)
    assert found.image.dtype == result
    np.testing.assert_allclose(found.image.astype(float), picture.astype(float), rtol=rounding)
    assert found.convergence < rounding * value
    one = accumulate(lambda _: picture, samples=1).image
    np.testing.assert_array_equal(one, picture.astype(result))


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (None, "must be an array, got None"),
        (np.ones((4, 5)), r"must be an image of shape \(height, width, channel\)"),
        (np.ma.masked_array(np.ones((4, 5, 3))), "got a masked array"),
        ({"R": np.ones((4, 5))}, "one array, got a dict"),
        (np.ones((4, 5, 3), bool), "must hold real numbers, got bool"),
    ],
)
def test_pictures_that_are_none(picture, message):
    with pytest.raises(ValueError, match=rf"`accumulate\(render\)` .*{message}|{message}"):
        inspect.unwrap(dof.accumulate)(lambda _: picture, CAMERA, LENS, progress=False)


def test_numbers_of_passes():
    call = inspect.unwrap(dof.accumulate)
    picture = lambda _: np.ones((2, 2, 1))
    for samples in (np.int64(2), np.uint8(2)):
        call(picture, CAMERA, LENS, samples=samples, seed=np.int32(1), progress=False)
    for wrong in (True, 2.0, 0, "2"):
        with pytest.raises(ValueError, match=r"`accumulate\(samples=...\)` must be a positive"):
            call(picture, CAMERA, LENS, samples=wrong, progress=False)
    with pytest.raises(ValueError, match=r"`accumulate\(seed=...\)` must be an integer from 0"):
        call(picture, CAMERA, LENS, seed=-1, progress=False)
