"""Vignetting and profile of an iris against brute force, closed forms and many pinholes."""

import inspect
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import PinholeCamera, ThinLens, dof
from jaxfx._sampling import pixel_centers
from jaxfx.dof import Iris
from jaxfx.dof.iris import areas, check_iris, chord, outline
from tests.helpers.forms import first
from tests.helpers.quick import check_slopes


SIZE = 4, 5
FIELD = np.stack(np.meshgrid(np.arange(5) - 2, np.arange(4) - 1.5)) / math.hypot(4, 5) * 2


def limits(iris, center, y):
    """Where a line at each height lies in an opening, and in the unit disc about `center`."""
    bend = float(iris.roundness)
    circles = [(center, 1.0)] if iris.blades else [(center, 1.0), ((0.0, 0.0), 1.0)]
    start, end = np.full_like(y, -9), np.full_like(y, 9)
    for k in range(iris.blades):
        angle = float(iris.rotation) + (2 * k + 1) * math.pi / iris.blades
        apothem, half = math.cos(math.pi / iris.blades), math.sin(math.pi / iris.blades)
        if bend:
            away = apothem - math.sqrt(bend**-2 - half**2)
            circles.append(((away * math.cos(angle), away * math.sin(angle)), 1 / bend))
            continue
        at = (apothem - math.sin(angle) * y) / math.cos(angle)
        if math.cos(angle) > 0:
            end = np.minimum(end, at)
        else:
            start = np.maximum(start, at)
    for (across, down), radius in circles:
        square = radius**2 - (y - down) ** 2
        reach = np.sqrt(np.maximum(square, 0))
        start = np.where(square > 0, np.maximum(start, across - reach), 9)
        end = np.where(square > 0, np.minimum(end, across + reach), -9)
    is_there = end > start
    return np.where(is_there, start, 0), np.where(is_there, end, 0)


SHAPES = [Iris(), Iris(5, 0.1, 0.6, 0.7), Iris(3, 0.4), Iris(6, 0.3), Iris(4, 0.1, 0.9)]


@first(("iris", "dtype"), [(x, d) for d in ("float64", "float32") for x in SHAPES])
def test_what_the_rim_leaves_has_area_and_mean_of_each_row(iris, dtype):
    """At each pixel, by lines that are close together."""
    radius, close = 3.3, 4000
    rows = jnp.arange(-4, 5)

    @jax.jit
    def found(vignetting):
        bend = iris.roundness if float(iris.roundness) else None
        shape = eqx.tree_at(
            lambda x: (x.vignetting, x.profile, x.roundness),
            iris,
            (vignetting, None, bend),
        )
        shape = outline(shape, dtype, SIZE)
        ones = jnp.ones(SIZE, dtype)
        at_row = lambda row: chord(shape, radius * ones, ones, row)
        return areas(shape), *jax.lax.map(at_row, rows)

    y = (np.arange(-4.5 * close, 4.5 * close) + 0.5) / close / radius
    accuracy = 4e-6 if dtype == "float64" else 2e-5
    for vignetting in (0.0, 1e-8, 1e-3, 0.4, 1.0):
        area, center, half = (np.asarray(x, float) for x in found(np.asarray(vignetting)))
        exactly = 1e-12 if dtype == "float64" else 2e-6
        np.testing.assert_allclose(2 * half.sum(axis=0) / radius**2, area, rtol=exactly)
        for at in ((0, 0), (1, 2), (2, 1), (3, 3)):
            start, end = limits(iris, -vignetting * FIELD[:, *at], y)
            width = float(iris.squeeze) * radius
            by_row = lambda x: x.reshape(len(rows), close).mean(axis=1)
            across = by_row(width * (end - start))
            moment = by_row(width**2 * (end**2 - start**2) / 2)
            mine = 2 * half[:, *at]
            assert np.abs(mine - across).max() < accuracy * radius**2
            assert np.abs(mine * center[:, *at] - moment).max() < accuracy * radius**3


@pytest.mark.full
def test_the_open_share_is_that_of_two_discs():
    share_of = jax.jit(lambda vignetting: Iris(vignetting=vignetting).open_share(*SIZE))
    share = share_of(0.8)
    away = 0.8 * np.hypot(*FIELD)
    expected = 2 * np.arccos(away / 2) - away / 2 * np.sqrt(4 - away**2)
    np.testing.assert_allclose(share, expected / math.pi, rtol=1e-12)
    assert (Iris(6).open_share(*SIZE) == 1).all()
    # From 0 on each pixel loses 2 / pi of its field.
    slope = jax.jit(jax.jacfwd(share_of))(0.0)
    np.testing.assert_allclose(slope, -2 / math.pi * np.hypot(*FIELD), atol=1e-12)


@first("program", ["spans", "layered", "shift"])
def test_a_light_has_the_light_of_each_point_of_the_lens(program):
    """Rings and rim, off the axis, by points of the lens that are counted pixel by pixel."""
    size, at, radius, rings = (72, 70), (52, 16), 5.0, 3
    iris = Iris(5, 0.3, 0.5, 0.8, vignetting=0.9, profile=-0.7, rings=rings)
    away = np.array([at[1] - 34.5, at[0] - 35.5]) / math.hypot(*size) * 2
    close = 80
    line = (np.arange(-11 * close, 11 * close) + 0.5) / (2 * close) / radius
    rows = {}
    for ring in range(1, rings + 1):
        scale = math.sqrt(ring / rings)
        inner, outer = 1 - 2 * (ring - 0.5) / rings, 1 - 2 * (ring + 0.5) / rings
        step = 1 - 0.7 * inner - (1 - 0.7 * outer if ring < rings else 0)
        rows[scale] = step
    expected = np.zeros((11, 11))
    for scale, step in rows.items():
        start, end = limits(iris, -0.9 * away, line / scale)
        start, end = (scale * radius * 0.8 * x.reshape(11, -1) for x in (start, end))
        pixel = np.arange(-5, 6)[:, None, None]
        covered = np.minimum(end, pixel + 0.5) - np.maximum(start, pixel - 0.5)
        expected += step * np.maximum(covered, 0).mean(axis=2).T
    image = np.zeros((*size, 1))
    image[at] = 1.0
    depth, lens = np.full(size, 4.0), ThinLens(0.1, 2.0, 2 * radius / 0.025)
    options = {"iris": iris, "max_coc": 10.0}
    if program == "layered":
        result = dof.layered(image, depth, lens, behind=None, **options)
    else:
        result = dof.scatter(image, depth, lens, program=program, **options)
    seen = np.asarray(result)[47:58, 11:22, 0]
    # All sprites are moved a little towards the middle, where there is then more light.
    assert abs(seen.sum() - 1) < 0.1
    # Spans end sharply within a row; in sum, row by row, they are exact.
    expected, seen = expected / expected.sum(), seen / seen.sum()
    np.testing.assert_allclose(seen.sum(axis=1), expected.sum(axis=1), atol=5e-3)
    assert np.abs(seen - expected).sum() / 2 < 0.08


@first("method", [dof.scatter, dof.layered])
def test_an_even_picture_stays_even(method):
    depth, lens = np.full((9, 12), 4.0), ThinLens(0.1, 2.0, 160.0)
    iris = Iris(vignetting=1.0, profile=0.8, rings=2)
    result = method(np.full((9, 12, 1), 0.3), depth, lens, iris=iris, max_coc=4.0)
    np.testing.assert_allclose(result, 0.3, rtol=1e-9)


SLOPES = [Iris(), Iris(5, 0.2, 0.3, 0.8), Iris(4, 0.3)]


@pytest.mark.full
@pytest.mark.parametrize("iris", SLOPES)
@pytest.mark.parametrize("program", ["shift", "spans", "layered"])
def test_derivatives(program, iris):
    rng = np.random.default_rng(2)
    image, weight = (jnp.asarray(rng.random((6, 7, 1))) for _ in range(2))
    depth = jnp.asarray(rng.uniform(1.0, 8.0, (6, 7)))

    def loss(depth, aperture, numbers):
        rotation, squeeze, vignetting, profile = numbers
        shape = eqx.tree_at(
            lambda x: (x.rotation, x.squeeze, x.vignetting, x.profile),
            Iris(iris.blades, iris.rotation, iris.roundness, rings=2),
            (rotation, squeeze, vignetting, profile),
        )
        lens = ThinLens(aperture, 2.5, 80.0)
        if program == "layered":
            out = dof.layered(image, depth, lens, behind=None, iris=shape, max_coc=6.0)
        else:
            options = {"gamma": 1.3, "epsilon": 0.7, "max_coc": 6.0, "program": program}
            out = dof.scatter(image, depth, lens, iris=shape, **options)
        return jnp.sum(weight * out)

    numbers = jnp.stack([iris.rotation, 0.9 * iris.squeeze, jnp.asarray(0.6), jnp.asarray(0.4)])
    operands = depth, jnp.asarray(0.1), numbers
    check_slopes(loss, operands, atol=2e-5, rtol=2e-5, eps=1e-6)
    # At 0: there is no vignetting below.
    at_zero = numbers.at[2:].set(0.0)
    slope = jax.grad(loss, argnums=2)(*operands[:2], at_zero)
    step = 1e-6
    value = lambda index, by: loss(*operands[:2], at_zero.at[index].add(by))
    one_sided = (4 * value(2, step) - value(2, 2 * step) - 3 * value(2, 0.0)) / (2 * step)
    assert abs(slope[2] - one_sided) < 2e-5
    both = (value(3, step) - value(3, -step)) / (2 * step)
    assert abs(slope[3] - both) < 2e-5


SIDE = 64
WALL = PinholeCamera.from_fov(0.8, height=SIDE, width=SIDE)
LENS = ThinLens.from_camera(WALL, aperture=0.64, focus_distance=2.0)


@pytest.mark.full
@pytest.mark.parametrize("method", [dof.scatter, dof.layered])
def test_effects_show_what_many_pinholes_show(method):
    """A light in a corner of a plane through the lens whose points `accumulate` weighs."""

    def render(camera):
        pixels = pixel_centers(SIDE, SIDE, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full((SIDE, SIDE), 3.4, pixels.dtype))
        away = points[..., :2] * WALL.intrinsics[0, 0] / 3.4 + 16
        return jnp.exp(-jnp.sum(away**2, axis=-1))[..., None]

    iris = Iris(vignetting=0.9, profile=-0.8, rings=4)
    options = {"samples": 256, "jitter": False}
    expected = dof.accumulate(jax.jit(render), WALL, LENS, iris=iris, **options).image
    depth = jnp.full((SIDE, SIDE), 3.4)  # Circles of 10 pixels.

    def difference(iris):
        seen = method(render(WALL), depth, LENS, max_coc=12.0, iris=iris)
        return float(jnp.abs(seen / seen.sum() - expected / expected.sum()).sum()) / 2

    found = difference(iris)
    assert found < 0.08
    # Without the rim or the profile it is worse.
    for other in (Iris(profile=-0.8, rings=4), Iris(vignetting=0.9)):
        assert difference(other) > 2 * found


def test_many_pinholes_have_the_slope_of_the_profile():
    def render(camera):
        pixels = pixel_centers(4, 4, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full((4, 4), 3.4, pixels.dtype))
        return jnp.sin(3 * points[..., :1])

    def loss(profile):
        iris = Iris(3, 0.1, vignetting=0.5, profile=profile, rings=2)
        return jnp.sum(dof.accumulate(render, WALL, LENS, iris=iris, samples=6).image ** 2)

    check_slopes(loss, (np.array(0.2),), atol=1e-6, rtol=1e-6, eps=1e-5)
    with pytest.raises(ValueError, match=r"accumulate\(iris.vignetting\)` must be concrete"):
        jax.grad(
            lambda v: dof.accumulate(render, WALL, LENS, iris=Iris(vignetting=v)).image.sum()
        )(0.1)


def test_an_iris_without_them_is_the_plain_one():
    plain = check_iris("iris", Iris(6))
    assert plain.vignetting is None and plain.profile is None
    shape = outline(plain, "float32", SIZE)
    assert shape.rim is None and shape.rings is None


def test_errors_name_what_is_wrong():
    for name, wrong in (
        ("vignetting", 1.1),
        ("vignetting", -0.1),
        ("profile", 2.0),
        ("rings", 0),
    ):
        with pytest.raises(ValueError, match=rf"Iris\({name}\)"):
            inspect.unwrap(Iris)(**{name: wrong})


def test_a_batch_of_rims_is_each_by_itself():
    rng = np.random.default_rng(5)
    image, depth = rng.random((6, 7, 1)), rng.uniform(1, 8, (6, 7))
    draw = lambda numbers: dof.scatter(
        image,
        depth,
        ThinLens(0.1, 2.0, 60.0),
        iris=Iris(vignetting=numbers[0], profile=numbers[1], rings=2),
        max_coc=6.0,
    )
    numbers = np.array([[0.2, 0.5], [0.9, -0.4]])
    each = np.stack([jax.jit(draw)(x) for x in numbers])
    np.testing.assert_allclose(jax.jit(jax.vmap(draw))(numbers), each, atol=1e-12)


@first("method", [dof.scatter, dof.layered])
def test_the_corner_is_that_of_the_frame_within_a_margin(method):
    """The last pixels, repeated: inside of their reach all is as without them."""
    image = np.random.default_rng(0).random((20, 24, 1))
    lens, iris = ThinLens(1.0, 2.0, 12.0), Iris(vignetting=0.9)

    def blur(image, **more):
        depth = np.full(image.shape[:2], np.inf)
        return np.asarray(method(image, depth, lens, max_coc=6.0, iris=iris, **more))

    wider = np.pad(image, [(5, 5), (5, 5), (0, 0)], mode="edge")
    inside = lambda x: x[3:-3, 3:-3]
    expected = inside(blur(image))
    np.testing.assert_allclose(inside(blur(wider, margin=5)), expected, atol=1e-12)
    assert np.abs(inside(blur(wider)[5:-5, 5:-5]) - expected).max() > 0.01
    # A margin that is far wider than the frame.
    small = blur(wider, margin=14)
    assert small.shape == (2, 6, 1) and np.isfinite(small).all()
