"""Depth from files, networks and pairs of cameras, against each formula in NumPy."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import OrthographicCamera, PinholeCamera, depth
from tests.helpers.forms import first


NAN, INF = np.nan, np.inf
HOLES = np.array([[0.0, -0.0, -3.0, -INF, NAN, INF, 2.0]])
CLEAN = np.array([[NAN, NAN, NAN, NAN, NAN, INF, 2.0]])


def slopes(function, *arguments):
    """Forward and reverse derivatives against differences, of a weighted sum of what is finite.

    At a hole of the first argument both are 0: no difference can be taken there.
    """
    is_known = np.isfinite(arguments[0]) & (arguments[0] > 0)
    weight = np.random.default_rng(0).normal(size=is_known.shape)

    @jax.jit
    def total(values):
        found = function(*values)
        return jnp.sum(jnp.where(jnp.isfinite(found), found, 0) * weight)

    reverse = jax.device_get(jax.jit(jax.grad(total))(arguments))
    push = jax.jit(lambda along: jax.jvp(total, (arguments,), (along,))[1])
    assert all(np.isfinite(slope).all() for slope in reverse)
    np.testing.assert_array_equal(reverse[0][~is_known], 0)
    for i, argument in enumerate(arguments):
        for at in np.ndindex(argument.shape):
            if i == 0 and not is_known[at]:
                continue
            along = [np.zeros_like(a) for a in arguments]
            along[i][at] = 1
            moved = [
                total(tuple(a + sign * 1e-6 * v for a, v in zip(arguments, along, strict=True)))
                for sign in (1, -1)
            ]
            numeric = (float(moved[0]) - float(moved[1])) / 2e-6
            np.testing.assert_allclose(reverse[i][at], numeric, rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(push(tuple(along)), numeric, rtol=1e-6, atol=1e-7)


def test_holes_have_one_convention():
    np.testing.assert_array_equal(depth.clean(HOLES), CLEAN)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_what_renderers_write_for_a_sky(dtype):
    with np.errstate(over="ignore"):
        marks = np.array([[1e10, 65504, 3e38, INF, 65472, 7]]).astype(dtype)
    found = depth.clean(marks)
    np.testing.assert_array_equal(found, [[INF, INF, INF, INF, 65472, 7]])
    assert found.dtype == max(np.dtype(dtype), np.dtype(np.float32))


def test_other_marks_of_a_sky():
    values = np.array([[1e10, 65504.0, 1000.0, 999.0]])
    np.testing.assert_array_equal(depth.clean(values, sky=()), values)
    found = depth.clean(values, sky=(1000.0,), unit=2)
    np.testing.assert_array_equal(found, [[INF, INF, INF, 1998]])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int64, ">u2"])
def test_millimetres(dtype):
    """Of integers no number is a sky, but the one that the caller names."""
    steps = np.array([[0, 1, 250]]).astype(dtype)
    np.testing.assert_allclose(depth.clean(steps, unit=1 / 1000), [[NAN, 0.001, 0.25]])
    np.testing.assert_array_equal(depth.clean(steps, sky=(250,)), [[NAN, 1, INF]])


def test_the_largest_integer_is_a_depth():
    steps = np.array([[65504, 65535]], np.uint16)
    np.testing.assert_allclose(depth.clean(steps, unit=1 / 5000), steps / 5000)


def test_layouts_that_come_from_outside():
    values = np.arange(1.0, 7.0).reshape(2, 3)
    masked = np.ma.masked_equal(values, 3)
    np.testing.assert_array_equal(depth.clean(masked), np.where(values == 3, NAN, values))
    counts = np.ma.masked_equal(values.astype(np.uint16), 3)
    np.testing.assert_array_equal(depth.clean(counts), np.where(values == 3, NAN, values))
    for other in (values.astype(">f4"), values[::-1][::-1], np.asfortranarray(values)):
        np.testing.assert_array_equal(depth.clean(other), values)
    np.testing.assert_array_equal(inspect.unwrap(depth.clean)(values.tolist()), values)


def test_disparity_of_one_image():
    disparity = np.array([[0.0, 1.0, 3.0, -1.0, -2.0, NAN, INF]])
    found = depth.from_disparity(disparity, scale=0.5, shift=0.5)
    with np.errstate(divide="ignore"):
        inverse = 0.5 * disparity + 0.5
    expected = np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1), NAN)
    expected[0, 3], expected[0, 6] = INF, NAN
    np.testing.assert_allclose(found, expected)
    # Without a shift, a disparity of 0 is infinitely far.
    np.testing.assert_array_equal(depth.from_disparity(np.array([[0]]), scale=2), [[INF]])


def test_disparity_of_a_pair():
    """A point is projected into two cameras whose principal points differ by `doffs`."""
    focal, baseline, doffs = 995.0, 0.193, 31.1
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 9], (4, 5, 3))
    x, _, z = np.moveaxis(points, -1, 0)
    left, right = focal * x / z + 300, focal * (x - baseline) / z + 300 + doffs
    found = depth.from_stereo(
        left - right + 40 * doffs,
        focal_pixels=focal,
        baseline=baseline,
        disparity_offset=doffs - 40 * doffs,
    )
    np.testing.assert_allclose(found, z, rtol=1e-12)


def test_no_match_is_missing():
    """0 of KITTI, -1 of OpenCV, inf of Middlebury; not infinitely far, whatever the offset."""
    disparity = np.array([[0.0, -1.0, INF, NAN, 4.0]])
    for offset in (0.0, 2.0):
        found = depth.from_stereo(
            disparity, focal_pixels=10, baseline=0.5, disparity_offset=offset
        )
        np.testing.assert_allclose(found, [[NAN] * 4 + [5 / (4 + offset)]])
    beyond = depth.from_stereo(disparity, focal_pixels=10, baseline=0.5, disparity_offset=-5.0)
    assert np.isnan(beyond).all()


def test_ray_distance():
    """The distance from the eye to a point, by the camera's own unprojection."""
    pose = np.eye(4)
    pose[:3, 3] = 1, -2, 5
    camera = PinholeCamera([[20, 0.3, 4], [0, 18, 3], [0, 0, 1]], pose)
    z = np.random.default_rng(0).uniform(1, 9, (6, 8))
    j, i = np.mgrid[:6, :8] + 0.5
    points = camera.unproject(np.stack([i, j], -1), z)
    distance = np.linalg.norm(np.asarray(points) - pose[:3, 3], axis=-1)
    np.testing.assert_allclose(depth.from_ray_distance(distance, camera), z, rtol=1e-12)


def test_ray_distance_of_parallel_rays():
    camera = OrthographicCamera(2, [1, 1], np.eye(4))
    np.testing.assert_array_equal(depth.from_ray_distance(HOLES, camera), CLEAN)


def test_holes_of_a_ray_distance():
    camera = PinholeCamera.from_fov(1.0, height=1, width=7)
    found = depth.from_ray_distance(HOLES, camera)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(CLEAN))
    np.testing.assert_array_equal(np.isinf(found), np.isinf(CLEAN))


HOLED = np.array([[1.3, 0.0, NAN], [INF, -2.0, 0.7]])


def test_slopes_of_clean():
    slopes(lambda d, s: depth.clean(d, unit=s), HOLED, np.array(1.5))


def test_slopes_of_disparity():
    slopes(
        lambda d, a, b: depth.from_disparity(d, scale=a, shift=b),
        np.where(HOLED <= 0, NAN, HOLED),
        np.array(1.5),
        np.array(0.2),
    )


def test_slopes_of_a_pair():
    slopes(
        lambda d, f, b, o: depth.from_stereo(d, focal_pixels=f, baseline=b, disparity_offset=o),
        HOLED,
        np.array(20.0),
        np.array(0.3),
        np.array(0.1),
    )


def test_slopes_of_ray_distance():
    matrix = np.array([[20.0, 0.3, 1.1], [0.2, 18, 0.9], [0.01, 0.02, 1]])

    def to_depth(distance, intrinsics):
        return depth.from_ray_distance(distance, PinholeCamera(intrinsics, np.eye(4)))

    slopes(to_depth, HOLED, matrix)


def test_the_slope_where_a_denominator_is_0_is_0():
    slope = jax.jit(
        jax.grad(lambda s: depth.from_disparity(np.array([[2.0]]), scale=s, shift=-2.0).sum())
    )
    assert float(slope(1.0)) == 0


ROWS = [
    [NAN, 3, NAN, NAN, 5, NAN],
    [NAN, NAN, NAN, NAN, NAN, NAN],
    [1, NAN, 2, NAN, 1, 7],
]


def test_filled_by_rows():
    expected = [[3, 3, 5, 5, 5, 5], [3, 3, 5, 5, 5, 7], [1, 2, 2, 2, 1, 7]]
    found = depth.fill(np.array(ROWS), method="rows")
    np.testing.assert_array_equal(found.depth, expected)
    np.testing.assert_array_equal(found.filled, np.isnan(ROWS))


def test_a_row_and_a_column_that_know_nothing():
    values = np.zeros((5, 6))
    values[3, 4] = 2
    for method in ("rows", "guided"):
        np.testing.assert_array_equal(
            depth.fill(values, method=method).depth, np.full((5, 6), 2)
        )


def scene(size=(48, 64)):
    """A disc before a wall, the depth and an image of the two; depths differ within each."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: size[0], : size[1]]
    is_disc = (y - 24) ** 2 + (x - 32) ** 2 < 14**2
    values = np.where(is_disc, 1 + 0.001 * x, 3 + 0.002 * y)
    image = np.where(is_disc[..., None], [0.7, 0.2, 0.1], [0.2, 0.4, 0.5])
    return is_disc, values, image + rng.normal(0, 0.01, image.shape)


@pytest.mark.full
def test_the_image_guides():
    """A hole over the edge of the disc ends up on both sides of it, as the image shows."""
    is_disc, values, image = scene()
    hole = np.zeros_like(is_disc)
    hole[14:34, 36:56] = True
    found = depth.fill(np.where(hole, 0, values), image)
    np.testing.assert_array_equal(found.filled, hole)
    assert np.mean((found.depth < 2) == is_disc) > 0.998
    blind = depth.fill(np.where(hole, 0, values))
    assert np.mean((blind.depth < 2) == is_disc) < 0.98


@pytest.mark.full
def test_the_shadow_beside_a_near_thing_is_behind_it():
    """In grey alone, where the image says nothing, the farther side of the gap goes on."""
    is_disc, values, _ = scene()
    shadow = np.roll(is_disc, -7, axis=1) & ~is_disc
    found = depth.fill(np.where(shadow, 0, values), np.full((48, 64, 3), 0.5))
    assert np.mean(found.depth[shadow] > 2) > 0.9


def test_no_specks():
    """No filled pixel stands alone: each is like two of its neighbours."""
    rng = np.random.default_rng(1)
    _, values, image = scene()
    missing = rng.uniform(size=values.shape) < 0.4
    missing[10:20, 30:45] = True
    missing[:3] = True
    found = np.asarray(depth.fill(np.where(missing, NAN, values), image).depth)
    padded = np.pad(found, 1, constant_values=NAN)
    around = np.stack(
        [padded[dy : dy + 48, dx : dx + 64] for dy in range(3) for dx in range(3)]
    )
    alike = np.sum(np.abs(around / found - 1) < 0.1, axis=0) - 1
    assert alike[missing].min() >= 2
    assert np.isin(found, values).all()


def test_what_is_known_stays_and_depths_are_copied():
    rng = np.random.default_rng(2)
    values = rng.uniform(1, 9, (20, 30))
    values[:4] = INF
    missing = rng.uniform(size=values.shape) < 0.5
    image = rng.uniform(size=(20, 30, 1))
    for method in ("rows", "guided"):
        found = depth.fill(np.where(missing, 0, values), image, method=method)
        np.testing.assert_array_equal(np.asarray(found.depth)[~missing], values[~missing])
        assert np.isin(found.depth, values[~missing]).all()
        np.testing.assert_array_equal(found.filled, missing)


@pytest.mark.full
def test_a_sky_alone():
    values = np.array([[INF, NAN], [NAN, 1e10]])
    for method in ("rows", "guided"):
        assert np.isinf(depth.fill(values, method=method).depth).all()


@first("method", ["rows", "guided"])
@pytest.mark.full
def test_a_slope_goes_to_the_depth_that_is_copied(method):
    rng = np.random.default_rng(3)
    values = rng.uniform(1, 9, (7, 8))
    missing = rng.uniform(size=values.shape) < 0.5
    image = rng.uniform(size=(7, 8, 3))
    weight = rng.normal(size=(7, 8))
    holed = np.where(missing, NAN, values)

    def total(given):
        return (depth.fill(given, image, method=method).depth * weight).sum()

    found = np.asarray(depth.fill(holed, image, method=method).depth)
    expected = [[weight[found == value].sum() for value in row] for row in holed]
    np.testing.assert_allclose(jax.grad(total)(holed), expected, atol=1e-12)
    along = rng.normal(size=(7, 8))
    pushed = jax.jvp(total, (holed,), (along,))[1]
    np.testing.assert_allclose(pushed, np.sum(np.where(missing, 0, expected * along)))
    guide_slope = jax.grad(lambda i: depth.fill(holed, i, method=method).depth.sum())(image)
    np.testing.assert_array_equal(guide_slope, np.zeros_like(image))


@first("method", ["rows", "guided"])
def test_holes_under_jit_and_vmap(method):
    rng = np.random.default_rng(4)
    holed = np.where(rng.uniform(size=(3, 9, 8)) < 0.5, NAN, rng.uniform(1, 9, (3, 9, 8)))
    image = rng.uniform(size=(3, 9, 8, 3))
    fill = jax.jit(jax.vmap(lambda d, i: depth.fill(d, i, method=method).depth))
    each = [depth.fill(d, i, method=method).depth for d, i in zip(holed, image, strict=True)]
    np.testing.assert_array_equal(fill(holed, image), each)
    nothing = jax.jit(lambda d: depth.fill(d, method=method).depth)(np.zeros((2, 3)))
    assert np.isnan(nothing).all()


GOOD = np.ones((2, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: depth.clean(np.ones(3)), r"`clean\(depth\)` must be of shape .* got \(3,\)"),
        (lambda: depth.clean(GOOD[:0]), r"got \(0, 3\)"),
        (lambda: depth.clean(GOOD.astype(str)), r"`clean\(depth\)` must hold real numbers"),
        (lambda: depth.clean(None), r"`clean\(depth\)` must be an array, got None"),
        (lambda: depth.clean(GOOD > 0), r"must hold real numbers, got bool"),
        (
            lambda: depth.clean(GOOD, unit=0),
            r"`clean\(unit=...\)` must be positive and finite",
        ),
        (lambda: depth.clean(GOOD, unit=INF), r"`clean\(unit=...\)` must be positive"),
        (
            lambda: depth.from_disparity(GOOD, scale=GOOD),
            r"`from_disparity\(scale=...\)` must have shape \(\)",
        ),
        (
            lambda: depth.from_stereo(GOOD, focal_pixels=0, baseline=1),
            r"`from_stereo\(focal_pixels=...\)` must be positive, got 0",
        ),
        (
            lambda: depth.from_stereo(GOOD, focal_pixels=1, baseline=-1),
            r"`from_stereo\(baseline=...\)` must be positive, got -1",
        ),
        (
            lambda: depth.from_ray_distance(GOOD[0], PinholeCamera(np.eye(3), np.eye(4))),
            r"`from_ray_distance\(distance\)` must be of shape",
        ),
        (lambda: depth.fill(0 * GOOD), r"`fill\(depth\)` must be known somewhere"),
        (
            lambda: depth.fill(GOOD, np.ones((3, 2, 3))),
            r"`fill\(image\)` must have the depth's .* \(2, 3\), got shape \(3, 2, 3\)",
        ),
        (lambda: depth.fill(GOOD, GOOD), r"`fill\(image\)` must be an image of shape"),
        (
            lambda: depth.fill(GOOD, np.ones((2, 3, 3), np.uint8)),
            r"`fill\(image\)` must hold floats .* got uint8",
        ),
        (lambda: depth.fill(GOOD, method="best"), r"`fill\(method=...\)` must be"),
    ],
)
def test_errors(monkeypatch, call, message):
    for name in depth.__all__:
        function = getattr(depth, name)
        if inspect.isfunction(function):
            monkeypatch.setattr(depth, name, inspect.unwrap(function))
    with pytest.raises(ValueError, match=message):
        call()


def test_numpys_own_type_is_taken_without_a_word(recwarn):
    """As users have JAX, without float64: the tests' filter makes an error of any warning."""
    with jax.enable_x64(False):
        assert depth.clean(np.ones((2, 3))).dtype == np.float32
    assert not recwarn.list
