"""Irises against polygons that are clipped in NumPy, closed forms and many pinhole images."""

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
from jaxfx.dof.accumulate import iris_samples
from jaxfx.dof.iris import check_iris, chord, outline
from tests.helpers.forms import first
from tests.helpers.quick import check_slopes


SHAPES = {
    "hexagon": Iris(6),
    "turned pentagon": Iris(5, rotation=0.3),
    "rounded and squeezed": Iris(5, rotation=0.1, roundness=0.6, squeeze=0.6),
    "upright triangle": Iris(3, rotation=math.pi / 2),
    "ellipse": Iris(squeeze=0.5),
    "nearly a disc": Iris(8, roundness=0.999),
}


def polygon(iris, points=1000):
    """The outline as a polygon, corner by corner, in radii of the disc; arcs by chords."""
    blades, bend = (iris.blades, float(iris.roundness)) if iris.blades else (4, 1.0)
    found = []
    for k in range(blades):
        ends = float(iris.rotation) + 2 * np.pi / blades * np.array([k, k + 1])
        first, last = np.stack([np.cos(ends), np.sin(ends)], axis=1)
        if bend == 0:
            found.append(first[None])
            continue
        middle, half = (first + last) / 2, np.linalg.norm(last - first) / 2
        out = middle / np.linalg.norm(middle)
        center = middle - out * math.sqrt(bend**-2 - half**2)
        spread = math.asin(bend * half) * np.linspace(-1, 1, points, endpoint=False)
        angle = math.atan2(out[1], out[0]) + spread
        found.append(center + np.stack([np.cos(angle), np.sin(angle)], axis=1) / bend)
    return np.concatenate(found) * [float(iris.squeeze), 1]


def clipped(corners, axis, low, high):
    """The part of a convex polygon between two values of a coordinate (Sutherland-Hodgman)."""
    for sign, bound in ((1, low), (-1, -high)):
        ahead = np.roll(corners, -1, axis=0)
        here, there = sign * corners[:, axis] - bound, sign * ahead[:, axis] - bound
        is_kept, is_crossed = here >= 0, (here >= 0) != (there >= 0)
        share = here / np.where(is_crossed, here - there, 1)
        crossings = corners + share[:, None] * (ahead - corners)
        both, are_there = np.stack([corners, crossings], 1), np.stack([is_kept, is_crossed], 1)
        corners = both[are_there]  # Each corner before the crossing behind it.
    return corners


def area_and_moment(corners):
    """Of a polygon: its area, and the integral of x over it."""
    (x, y), (x_next, y_next) = corners.T, np.roll(corners, -1, axis=0).T
    cross = x * y_next - x_next * y
    return cross.sum() / 2, ((x + x_next) * cross).sum() / 6


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SHAPES)
def test_chords_have_area_and_mean_of_each_row(name, dtype):
    iris = SHAPES[name]
    radii, sides, rows = np.array([0.4, 3.0, 7.77]), np.array([1.0, -1.0]), np.arange(-8, 9)
    row, side, radius = np.meshgrid(rows, sides, radii, indexing="ij")

    @jax.jit
    def chords(side, radius):
        shape = outline(check_iris("iris", iris), dtype)
        return jax.vmap(lambda row: chord(shape, radius, side, row))(jnp.asarray(rows))

    spans = chords(side[0].astype(dtype), radius[0].astype(dtype))
    center, half = (np.asarray(x, "float64") for x in spans)
    accuracy, whole = 2e-6 if dtype == "float64" else 1e-5, polygon(iris)
    for at in np.ndindex(row.shape):
        corners = clipped(side[at] * radius[at] * whole, 1, row[at] - 0.5, row[at] + 0.5)
        area, moment = area_and_moment(corners)
        assert abs(2 * half[at] - area) <= accuracy * radius[at] ** 2
        assert abs(2 * half[at] * center[at] - moment) <= accuracy * radius[at] ** 3
    total = float(iris.area()) * radius[0] ** 2
    exactly = 1e-12 if dtype == "float64" else 1e-5
    np.testing.assert_allclose(2 * np.sum(half, axis=0), total, rtol=exactly)


def loop(image, depth, lens, iris, gamma, epsilon):
    """Scatter of polygons, sprite by sprite and tap by tap."""
    height, width, channels = image.shape
    aperture, focus, focal = map(float, (lens.aperture, lens.focus_distance, lens.focal_pixels))
    defocus = aperture * focal * (1 / focus - 1 / depth)
    coc, shape = np.abs(defocus), polygon(iris, 300)
    sums, weights = np.zeros((height, width, channels)), np.zeros((height, width, 1))
    clamp = lambda t: min(max(t, 0.0), 1.0)
    for j, i in np.ndindex(height, width):
        radius = max(coc[j, i] / 2, 1e-3)
        sprite = np.sign(defocus[j, i]) * radius * shape
        whole, _ = area_and_moment(sprite)
        for y in range(height):
            strip = clipped(sprite, 1, y - j - 0.5, y - j + 0.5)
            area, moment = area_and_moment(strip)
            if area <= 1e-12:
                continue
            start, end = moment / area - area / 2, moment / area + area / 2
            for x in range(width):
                covered = max(min(x - i + 0.5, end) - max(x - i - 0.5, start), 0)
                if depth[j, i] < focus:
                    k = (focus / depth[j, i]) ** gamma
                else:
                    a = clamp((coc[j, i] - coc[y, x]) / epsilon)
                    k = 1 - a * (1 - clamp(coc[y, x] / epsilon - 1))
                sums[y, x] += k * covered / whole * image[j, i]
                weights[y, x] += k * covered / whole
    return sums / weights


def random_scene(seed, height=7, width=9):
    rng = np.random.default_rng(seed)
    image = rng.random((height, width, 3))
    depth = rng.uniform(1.0, 8.0, (height, width))
    depth[rng.random((height, width)) < 0.2] = np.inf
    return image, depth


@pytest.mark.parametrize("name", ["rounded and squeezed", "upright triangle"])
def test_scatter_equals_the_loop(name):
    image, depth = random_scene(0)
    lens, iris = ThinLens(0.1, 2.5, 80.0), SHAPES[name]
    expected = loop(image, depth, lens, iris, 1.3, 0.7)
    for program in ("shift", "spans"):
        options = {"gamma": 1.3, "epsilon": 0.7, "program": program}
        result = dof.scatter(image, depth, lens, iris=iris, **options)
        np.testing.assert_allclose(result, expected, atol=2e-5)


def test_an_iris_without_blades_is_the_disc():
    image, depth = random_scene(1)
    lens = ThinLens(0.1, 2.5, 80.0)
    expected = dof.scatter(image, depth, lens, gamma=1.0)
    result = dof.scatter(image, depth, lens, gamma=1.0, iris=Iris())
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("program", ["shift", "spans"])
@first("iris", [Iris(6, squeeze=0.9), Iris(5, rotation=0.2, roundness=0.3, squeeze=0.8)])
def test_scatter_derivatives(iris, program):
    image, depth = random_scene(2)
    depth = np.where(np.isinf(depth), 9.0, depth)
    weight = np.random.default_rng(3).random(image.shape)
    is_rounded = float(iris.roundness) > 0  # At 0 there is no value to the other side.

    def loss(image, depth, aperture, focus_distance, numbers, gamma):
        lens = ThinLens(aperture, focus_distance, 80.0)
        shape = eqx.tree_at(lambda x: (x.rotation, x.squeeze), iris, tuple(numbers[:2]))
        if is_rounded:
            shape = eqx.tree_at(lambda x: x.roundness, shape, numbers[2])
        options = {"gamma": gamma, "epsilon": 0.7, "max_coc": 8.0, "program": program}
        return jnp.sum(weight * dof.scatter(image, depth, lens, iris=shape, **options))

    numbers = np.stack([iris.rotation, iris.squeeze, iris.roundness])
    operands = image, depth, np.array(0.1), np.array(2.5), numbers, np.array(1.3)
    check_slopes(loss, operands, atol=1e-5, rtol=1e-5, eps=1e-6)


SIZE = 24
CAMERA = PinholeCamera.from_fov(0.8, height=SIZE, width=SIZE)
LENS = ThinLens.from_camera(CAMERA, aperture=1.0, focus_distance=2.0)


def accumulated(depth, iris):
    """A light of one pixel at a depth, through many points of the lens."""

    def render(camera):
        pixels = pixel_centers(SIZE, SIZE, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full((SIZE, SIZE), depth, pixels.dtype))
        width = depth / CAMERA.intrinsics[0, 0]
        is_lit = jnp.abs(points[..., :2] - width / 2) <= width / 2
        return is_lit.all(axis=-1).astype(pixels.dtype)[..., None]

    return dof.accumulate(jax.jit(render), CAMERA, LENS, iris=iris, samples=400, jitter=False)


def test_many_pinholes_have_the_slopes_of_rotation_and_squeeze():
    def render(camera):
        pixels = pixel_centers(4, 4, camera.intrinsics.dtype)
        points = camera.unproject(pixels, jnp.full((4, 4), 3.4, pixels.dtype))
        return jnp.sin(3 * points[..., :1]) * jnp.cos(2 * points[..., 1:2])

    def loss(rotation, squeeze):
        iris = Iris(3, rotation, 0.0, squeeze)
        return jnp.sum(dof.accumulate(render, CAMERA, LENS, iris=iris, samples=6).image ** 2)

    check_slopes(loss, (np.array(0.2), np.array(0.7)), atol=1e-6, rtol=1e-6, eps=1e-5)
    with pytest.raises(ValueError, match=r"accumulate\(iris.roundness\)` must be concrete"):
        jax.grad(lambda bend: dof.accumulate(render, CAMERA, LENS, iris=Iris(3, 0.0, bend)))(
            0.1
        )


@pytest.mark.parametrize("depth", [3.4, 1.3])
def test_scatter_shows_the_shape_that_many_pinholes_show(depth):
    iris, middle = Iris(3, rotation=0.4, squeeze=0.7), SIZE // 2
    expected = np.asarray(accumulated(depth, iris).image)
    image, scene = np.zeros((SIZE, SIZE, 1)), np.full((SIZE, SIZE), depth)
    image[middle, middle] = 1.0

    def difference(iris):
        result = dof.scatter(image, scene, LENS, iris=iris, max_coc=16)
        return np.abs(np.asarray(result) - expected).sum() / 2

    # The share of the light that lies elsewhere.
    assert difference(iris) < 0.12
    assert difference(Iris(3, rotation=0.4 + math.pi, squeeze=0.7)) > 0.25
    assert difference(None) > 0.25


@pytest.mark.parametrize("name", SHAPES)
def test_points_of_the_lens_fill_the_shape(name):
    iris = SHAPES[name]
    points = np.asarray(iris_samples(check_iris("iris", iris), 4096)[0].squeezed)
    corners = polygon(iris, 200)
    ahead = np.roll(corners, -1, axis=0) - corners
    away = points[:, None] - corners
    assert (ahead[:, 0] * away[..., 1] - ahead[:, 1] * away[..., 0] > -1e-3).all()
    quarter = clipped(clipped(corners, 0, 0, 2), 1, 0, 2)
    share = area_and_moment(quarter)[0] / area_and_moment(corners)[0]
    assert abs((points > 0).all(axis=1).mean() - share) < 0.01


@first("method", [dof.scatter, dof.layered])
def test_energy_of_lights_is_kept(method):
    """A light of 50 times white fills the shape, and nothing beyond it."""
    image, depth = np.full((36, 36, 1), 1e-2), np.full((36, 36), 4.0)
    image[18, 18] = 50.0
    lens = ThinLens(0.1, 2.0, 400.0)  # Ten pixels.
    for iris in (Iris(6, rotation=0.2), Iris(squeeze=0.5)):
        result = np.asarray(method(image, depth, lens, iris=iris))[6:31, 6:31]
        np.testing.assert_allclose(np.sum(result), 50 + 1e-2 * (25**2 - 1), rtol=1e-9)
        lit = np.sum(result > 1e-2 + 1e-6)
        assert 0 < lit - 25 * float(iris.area()) < 35  # The pixels of the rim count in full.


@pytest.mark.parametrize("behind", [False, True])
def test_layered_by_an_iris_without_blades_is_the_disc(behind):
    """Two programs: this one paints all slices of a group by the same chords."""
    rng = np.random.default_rng(0)
    image = rng.random((20, 24, 2))
    depth = np.where(np.arange(24) < 11, 1.2, 3.0) + 0.3 * rng.random((20, 24))
    second = (image[::-1], depth + 2.0) if behind else None
    lens = ThinLens(1.0, 2.0, 14.0)
    expected = dof.layered(image, depth, lens, behind=second)
    result = dof.layered(image, depth, lens, behind=second, iris=Iris())
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_layered_shows_as_much_past_an_edge_as_the_iris_sees():
    """A black plane left of x = 16, twelve pixels out of focus, before a white one in focus."""
    iris, radius, edge = Iris(3, rotation=0.4, squeeze=0.7), 6.0, 16
    lens = ThinLens(1.0, 2.0, 24.0)
    is_left = np.broadcast_to(np.arange(32) < edge, (20, 32))
    image, depth = (~is_left[..., None]).astype(float), np.where(is_left, 1.0, 2.0)
    behind = np.ones_like(image), np.where(is_left, 2.0, np.inf)
    result = np.asarray(dof.layered(image, depth, lens, behind=behind, max_coc=12.0, iris=iris))
    shape = polygon(iris)
    whole, _ = area_and_moment(shape)
    for x in range(5, 27):
        # The sprites of the foreground are turned: from a pixel one looks along the shape.
        seen, _ = area_and_moment(clipped(radius * shape, 0, -99, edge - x - 0.5))
        expected = 1 - seen / whole / radius**2
        # Ends of spans are sharp within a row: exact is the area of rows, not of columns.
        assert abs(result[10, x, 0] - expected) < 0.02


@first("iris", [Iris(6, squeeze=0.9), Iris(5, rotation=0.2, roundness=0.3, squeeze=0.8)])
@pytest.mark.full
def test_layered_derivatives(iris):
    rng = np.random.default_rng(4)
    image, weight = (jnp.asarray(rng.random((9, 10, 2))) for _ in range(2))
    depth = jnp.asarray(np.where(np.arange(10) < 5, 1.3, 3.1) + 0.2 * rng.random((9, 10)))

    def loss(image, depth, second, numbers, rotation, squeeze, roundness):
        aperture, focus, threshold = numbers
        lens = ThinLens(aperture, focus, 14.0)
        shape = eqx.tree_at(lambda x: (x.rotation, x.squeeze), iris, (rotation, squeeze))
        if iris.blades == 5:
            shape = eqx.tree_at(lambda x: x.roundness, shape, roundness)
        options = {"max_coc": 6.0, "threshold": threshold, "behind": (second, depth + 2.0)}
        return jnp.sum(weight * dof.layered(image, depth, lens, iris=shape, **options))

    numbers = jnp.asarray([0.9, 2.03, 1.7])
    operands = image, depth, image[::-1], numbers, iris.rotation, iris.squeeze, iris.roundness
    check_slopes(loss, operands, atol=2e-5, rtol=2e-5, eps=1e-6)


def test_errors_name_what_is_wrong():
    image, depth = random_scene(0)
    lens = ThinLens(0.1, 2.5, 80.0)
    for program in ("tiles", "rows", "segment_sum"):
        with pytest.raises(ValueError, match=r"scatter\(iris=.*got '" + program):
            dof.scatter(image, depth, lens, iris=Iris(6), program=program)
    with pytest.raises(ValueError, match=r"scatter\(iris=...\)` must be an Iris, got int"):
        inspect.unwrap(dof.scatter)(image, depth, lens, iris=6)
    with pytest.raises(ValueError, match=r"layered\(iris=...\)` must be an Iris, got int"):
        inspect.unwrap(dof.layered)(image, depth, lens, iris=6)
    for name, wrong in (("blades", 2), ("roundness", 1.1), ("squeeze", 0.0), ("squeeze", 1.2)):
        with pytest.raises(ValueError, match=rf"Iris\({name}\)"):
            inspect.unwrap(Iris)(**{"blades": 6, name: wrong})
