"""Scatter against a plain loop, closed forms and finite differences."""

import functools as ft
import inspect
import math

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, dof
from tests.helpers.forms import first


PROGRAMS = ("segment_sum", "shift", "tiles", "spans", "rows")


def row_area(radius, row):
    """Half the disc's area in a row of pixels, by quadrature."""
    t = np.linspace(row - 0.5, row + 0.5, 20001)
    t = (t[1:] + t[:-1]) / 2
    return np.mean(np.sqrt(np.maximum(radius**2 - t**2, 0)))


def loop(image, depth, lens, gamma, epsilon):
    """The page's equation, sprite by sprite and tap by tap, in float64."""
    height, width, channels = image.shape
    aperture, focus, focal = map(float, (lens.aperture, lens.focus_distance, lens.focal_pixels))
    coc = aperture * focal * np.abs(1 / focus - 1 / depth)
    sums, weights = np.zeros((height, width, channels)), np.zeros((height, width, 1))
    clamp = lambda t: min(max(t, 0.0), 1.0)
    for j in range(height):
        for i in range(width):
            radius = max(coc[j, i] / 2, 1e-3)
            reach = math.ceil(radius + 1)
            for dy in range(-reach, reach + 1):
                half = row_area(radius, dy)
                for dx in range(-reach, reach + 1):
                    y, x = j + dy, i + dx
                    if not (0 <= y < height and 0 <= x < width):
                        continue
                    covered = max(min(dx + 0.5, half) - max(dx - 0.5, -half), 0)
                    if depth[j, i] < focus:
                        k = (focus / depth[j, i]) ** gamma
                    else:
                        a = clamp((coc[j, i] - coc[y, x]) / epsilon)
                        k = 1 - a * (1 - clamp(coc[y, x] / epsilon - 1))
                    a = k * covered / (math.pi * radius**2)
                    sums[y, x] += a * image[j, i]
                    weights[y, x] += a
    return sums / weights


def random_scene(seed, height=9, width=11, channels=3):
    rng = np.random.default_rng(seed)
    image = rng.random((height, width, channels))
    depth = rng.uniform(1.0, 8.0, (height, width))
    depth[rng.random((height, width)) < 0.2] = np.inf
    return image, depth


@pytest.mark.parametrize("program", PROGRAMS)
def test_equals_the_loop(program):
    image, depth = random_scene(0)
    lens = ThinLens(0.1, 2.5, 60.0)
    expected = loop(image, depth, lens, 1.3, 1.7)
    result = dof.scatter(image, depth, lens, gamma=1.3, epsilon=1.7, program=program)
    # The loop's quadrature is good to about 1e-6.
    np.testing.assert_allclose(result, expected, atol=5e-6)


@hyp.given(st.integers(0, 2**32 - 1), st.floats(0, 3), st.floats(0, 6), st.floats(0.5, 16))
@hyp.settings(max_examples=20, deadline=None)
@pytest.mark.full
def test_kernels_agree(seed, gamma, epsilon, coc):
    image, depth = random_scene(seed)
    lens = ThinLens(0.1, 2.5, 10 * coc)
    for dtype, tolerance in ((jnp.float64, 1e-10), (jnp.float32, 1e-4)):
        results = [
            dof.scatter(
                image.astype(dtype),
                depth.astype(dtype),
                lens,
                gamma=gamma,
                epsilon=epsilon,
                max_coc=12,
                program=program,
            )
            for program in (*PROGRAMS, "auto")
        ]
        for result in results[1:]:
            assert result.dtype == dtype
            np.testing.assert_allclose(result, results[0], atol=tolerance)


@first("radius", [0.0, 0.3, 0.5, 0.51, 1.0, 1.49, 2.7, 7.9, 20.0, 40.0], 7)
def test_a_point_of_light_keeps_its_energy_and_place(radius):
    # All pixels are blurred alike, so the weights sum to 1 away from the frame and the image
    # of a point is its sprite.
    largest = next(each for each in (8, 20, 40) if radius <= each)
    side = 2 * largest + 5
    size = 2 * side + 1
    image, depth = np.zeros((size, size, 1)), np.full((size, size), np.inf)
    image[side, side] = 1.0
    lens = ThinLens(1.0, 1.0, 2 * radius) if radius else ThinLens(0.0, 1.0, 1.0)
    blur = lambda image: dof.scatter(image, depth, lens, max_coc=2 * largest, program="shift")
    spread = np.asarray(blur(image))[..., 0]
    offset = np.arange(size) - side
    # Where nothing is cut by the frame, the weights are those of a full disc.
    middle = slice(side - math.ceil(radius) - 1, side + math.ceil(radius) + 2)
    assert spread[middle, middle].sum() == pytest.approx(spread.sum(), abs=1e-12)
    np.testing.assert_allclose(blur(np.ones((size, size, 1))), 1, atol=1e-12)
    assert spread.sum() == pytest.approx(1, abs=1e-5)
    assert abs((spread * offset).sum()) < 1e-3
    assert abs((spread * offset[:, None]).sum()) < 1e-3
    second = (spread * (offset**2 + offset[:, None] ** 2)).sum()
    # A disc's second moment; each of the two axes adds at most a pixel's own, 1/12 and 1/4.
    assert second - radius**2 / 2 == pytest.approx(0, abs=0.35)


def largest_step(spacing):
    """The largest change of an image between neighbours of a sweep of the radius, 0 to 2."""
    image, _ = random_scene(3, 12, 12)
    depth = jnp.full((12, 12), jnp.inf)
    radii = jnp.arange(0.0, 2.0 + spacing / 2, spacing)
    blur = lambda r: dof.scatter(image, depth, ThinLens(1.0, 1.0, 2 * r + 1e-9), max_coc=6)
    pictures = jax.jit(jax.vmap(blur))(radii)
    return np.abs(np.diff(pictures, axis=0)).max()


@pytest.mark.full
def test_radius_zero_to_two_has_no_jump():
    # A jump stays as it is when the sweep is refined; a slope shrinks with its step.
    coarse, fine, finest = map(largest_step, (0.05, 0.025, 0.0125))
    assert 1.7 < coarse / fine < 2.3
    assert 1.7 < fine / finest < 2.3


def test_in_focus_is_the_identity():
    image, _ = random_scene(4)
    depth = np.full(image.shape[:2], 2.5)
    np.testing.assert_allclose(
        dof.scatter(image, depth, ThinLens(0.3, 2.5, 99.0)), image, rtol=1e-15
    )
    _, depth = random_scene(4)
    np.testing.assert_allclose(
        dof.scatter(image, depth, ThinLens(0.0, 2.5, 99.0), gamma=2.0), image, rtol=1e-15
    )


@hyp.given(st.integers(0, 2**32 - 1), st.floats(0, 3), st.floats(0, 6))
@hyp.settings(max_examples=10, deadline=None)
def test_constant_linear_and_mirrored(seed, gamma, epsilon):
    image, depth = random_scene(seed)
    other, _ = random_scene(seed + 1)
    lens = ThinLens(0.1, 2.5, 60.0)

    def blur(image, depth=depth):
        options = {"gamma": gamma, "epsilon": epsilon, "max_coc": 10}
        return np.asarray(dof.scatter(image, depth, lens, **options))

    np.testing.assert_allclose(blur(np.full_like(image, 0.7)), 0.7, atol=1e-12)
    np.testing.assert_allclose(
        blur(2 * image + 3 * other), 2 * blur(image) + 3 * blur(other), atol=1e-12
    )
    # Not so transposed: the rim is exact by rows.
    for flip in (np.fliplr, np.flipud):
        np.testing.assert_allclose(
            blur(flip(image), flip(depth)), flip(blur(image)), atol=1e-12
        )


@first("shape", [(1, 1, 1), (1, 7, 3), (7, 1, 4), (13, 5, 2)])
@first("program", PROGRAMS)
@pytest.mark.full
def test_any_size(shape, program):
    image, depth = random_scene(5, *shape)
    lens = ThinLens(0.1, 2.5, 200.0)
    blur = lambda *data: dof.scatter(*data, lens, max_coc=13, program=program)
    result = jax.jit(blur)(image, depth)
    np.testing.assert_allclose(
        result, dof.scatter(image, depth, lens, program="segment_sum"), atol=1e-12
    )
    assert np.isfinite(result).all()


@first("program", PROGRAMS)
def test_a_bad_pixel_spoils_what_it_can_reach_and_no_more(program):
    image, depth = random_scene(6, 31, 31)
    depth = np.full_like(depth, 5.0)
    lens = ThinLens(0.1, 2.5, 200.0)  # C = 4, so two pixels and a half
    rows, columns = np.mgrid[:31, :31] - 15
    blur = jax.jit(lambda i, d: dof.scatter(i, d, lens, max_coc=8, program=program))
    good = np.asarray(blur(image, depth))
    for bad in (np.nan, np.inf, -np.inf):
        wrong = image.copy()
        wrong[15, 15, 1] = bad
        result = np.asarray(blur(wrong, depth))
        spoiled = np.isnan(result).all(axis=-1)
        assert spoiled[15, 15]
        assert not spoiled[np.hypot(rows, columns) > 2 + np.sqrt(0.5)].any()
        lost = np.hypot(rows, columns) > 5
        np.testing.assert_allclose(result[lost], good[lost], atol=1e-12)
    depth[15, 15] = np.nan
    result = np.asarray(blur(image, depth))
    assert not np.isnan(result[np.hypot(rows, columns) > 4 + np.sqrt(0.5)]).any()


def test_indicator_costs_energy_that_area_keeps():
    """What the paper's coverage loses: its sum over pixels jumps about the disc's area."""
    radius = np.arange(0.6, 4.0, 0.05)
    side = np.mgrid[-5:6, -5:6]
    error = [
        abs((side[0] ** 2 + side[1] ** 2 <= r * r).sum() / (math.pi * r * r) - 1)
        for r in radius
    ]
    assert max(error) > 0.3
    image, depth = random_scene(7)
    lens = ThinLens(0.1, 2.5, 60.0)
    options = {"gamma": 1.0, "max_coc": 8, "program": "segment_sum"}
    area = dof.scatter(image, depth, lens, **options)
    indicator = dof.scatter(image, depth, lens, coverage="indicator", **options)
    difference = np.abs(np.asarray(area) - np.asarray(indicator)).max()
    assert 0.1 < difference < 1


def differences(function, x, step=1e-6):
    return np.asarray((function(x + step) - function(x - step)) / (2 * step))


PARAMETERS = {
    "aperture": 0.1,
    "focus_distance": 2.5,
    "focal_pixels": 60.0,
    "gamma": 1.3,
    "epsilon": 1.7,
}


def inputs_of(seed, dtype=jnp.float64):
    """Everything that scatter depends on, at a smooth point: equal depths stand at a kink."""
    image, depth = random_scene(seed)
    depth = np.random.default_rng(seed).uniform(1.0, 8.0, depth.shape)
    return jax.tree.map(
        lambda x: np.array(x, dtype), PARAMETERS | {"image": image, "depth": depth}
    )


def picture(inputs, program, max_coc=8):
    lens = ThinLens(*(inputs[k] for k in ("aperture", "focus_distance", "focal_pixels")))
    options = {k: inputs[k] for k in ("gamma", "epsilon")}
    return dof.scatter(
        inputs["image"], inputs["depth"], lens, max_coc=max_coc, program=program, **options
    )


@ft.cache
def compiled(program, is_twice=False):
    """One program: compiling is most of the work.

    The image; the gradient of a weighted sum of it; both their derivatives along a direction,
    the gradient's only if that is asked for.
    """

    def gradient(inputs, weight):
        blurred, pull = jax.vjp(lambda inputs: picture(inputs, program), inputs)
        return blurred, *pull(weight)

    def derivatives(inputs, direction, weight):
        at, along = (inputs,), (direction,)
        if is_twice:
            return jax.jvp(lambda inputs: gradient(inputs, weight), at, along)
        pushed = jax.jvp(lambda inputs: picture(inputs, program), at, along)[1]
        return gradient(inputs, weight), (pushed, None)

    return jax.jit(derivatives)


SIGNS = np.sin(np.arange(9 * 11 * 3.0) ** 2).reshape(9, 11, 3)


@first("program", PROGRAMS)
@pytest.mark.parametrize("name", [*PARAMETERS, "image", "depth"])
def test_gradients(program, name):
    inputs = inputs_of(8)
    direction = jax.tree.map(np.zeros_like, inputs)
    direction[name] = np.random.default_rng(9).uniform(0.5, 1, inputs[name].shape)

    def loss(t):
        moved = jax.tree.map(lambda x, dx: x + t * dx, inputs, direction)
        return np.vdot(SIGNS, compiled(program, True)(moved, direction, SIGNS)[0][0])

    expected = differences(loss, 0.0)
    assert abs(expected) > 1e-4
    (_, gradient), (pushed, _) = compiled(program, True)(inputs, direction, SIGNS)
    np.testing.assert_allclose(np.vdot(SIGNS, pushed), expected, rtol=1e-6)
    np.testing.assert_allclose(np.vdot(gradient[name], direction[name]), expected, rtol=1e-6)


@pytest.mark.full
def test_gradients_with_one_tangent_only():
    inputs = inputs_of(8)
    (_, whole), _ = compiled("tiles", True)(inputs, inputs, SIGNS)
    for name in ("gamma", "image"):
        loss = lambda x, n=name: jnp.sum(SIGNS * picture(inputs | {n: x}, "tiles"))
        alone = jax.jit(jax.grad(loss))(inputs[name])
        np.testing.assert_allclose(alone, whole[name], atol=1e-10)


@first("program", PROGRAMS)
def test_gradient_at_a_silhouette(program):
    """Two flat-coloured planes, the near one before half of the far one: where path tracers'
    thin lenses return zero."""
    names = ("aperture", "focus_distance")
    near = np.broadcast_to(np.arange(11) < 5, (9, 11))
    planes = {"image": np.where(near, 0.9, 0.1)[..., None] * np.ones(3)}
    planes["depth"] = np.where(near, 1.6, 4.1)
    inputs = jax.tree.map(lambda x: np.asarray(x, float), PARAMETERS | planes)
    zero = jax.tree.map(np.zeros_like, inputs)
    along = {name: zero | {name: np.ones(())} for name in names}
    edge = lambda picture: np.asarray(picture)[4, 2:9].mean(axis=-1)
    run = compiled(program, True)
    for name in names:
        moved = lambda t, n=name: edge(run(inputs | {n: inputs[n] + t}, along[n], SIGNS)[0][0])
        expected = differences(moved, 0.0)
        assert np.abs(expected).max() > 1e-2
        forward = edge(run(inputs, along[name], SIGNS)[1][0])
        np.testing.assert_allclose(forward, expected, rtol=1e-3, atol=1e-7)
        for k in range(7):
            pixel = np.zeros((9, 11, 3))
            pixel[4, 2 + k] = 1 / 3
            reverse = run(inputs, along[name], pixel)[0][1][name]
            np.testing.assert_allclose(reverse, forward[k], atol=1e-10)


DEGENERATE = {
    "in focus": {"depth": 2.5},
    "epsilon 0": {"epsilon": 0.0},
    "gamma 0": {"gamma": 0.0},
    "gamma large": {"gamma": 80.0},
    "at infinity": {"depth": np.inf},
    "aperture 0": {"aperture": 0.0},
    "very near": {"depth": 1e-6},
}


@first("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("case", DEGENERATE)
@first("program", PROGRAMS)
def test_gradients_are_finite_where_they_degenerate(program, case, dtype):
    inputs = inputs_of(12, dtype)
    for name, value in DEGENERATE[case].items():
        if name == "depth":
            inputs[name][:, 3:] = value
        else:
            inputs[name] = np.asarray(value, dtype)
    direction = jax.tree.map(np.ones_like, inputs)
    run = compiled(program, dtype == jnp.float64)
    (blurred, gradient), (pushed, _) = run(inputs, direction, SIGNS.astype(dtype))
    for leaf in jax.tree.leaves((blurred, gradient, pushed)):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.full
def test_second_derivatives(program):
    inputs, zero = inputs_of(13), jax.tree.map(jnp.zeros_like, inputs_of(13))
    names = ("aperture", "focus_distance", "gamma", "epsilon")
    weight = SIGNS / SIGNS.size
    select = lambda gradient: np.array([gradient[name] for name in names])

    def gradient(t, name):
        moved = inputs | {name: inputs[name] + t}
        return select(compiled(program, True)(moved, zero, weight)[0][1])

    unit = lambda name: zero | {name: jnp.ones(())}
    hessian = np.array(
        [select(compiled(program, True)(inputs, unit(n), weight)[1][1]) for n in names]
    )
    expected = [differences(ft.partial(gradient, name=name), 0.0) for name in names]
    np.testing.assert_allclose(hessian, expected, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-10)


def test_half_images_keep_their_type():
    image, depth = random_scene(14)
    lens = ThinLens(0.1, 2.5, 60.0)
    result = dof.scatter(image.astype(jnp.float16), depth.astype(jnp.float32), lens)
    assert result.dtype == jnp.float16
    np.testing.assert_allclose(result, dof.scatter(image, depth, lens), atol=2e-3)


@pytest.mark.full
def test_focus_planes_are_a_lens():
    image, depth = random_scene(15)
    planes = FocusPlanes(1.0, 2.5, 8.0, 6.0)
    blur = lambda program: (
        lambda image, depth: dof.scatter(
            image, depth, planes, gamma=1.0, max_coc=6, program=program
        )
    )
    results = [jax.jit(blur(program))(image, depth) for program in PROGRAMS]
    np.testing.assert_allclose(results[0], results[1], atol=1e-12)
    assert np.abs(results[0] - image).max() > 0.1


BAD = {
    "image": ({"image": np.zeros((4, 5))}, "scatter\\(image\\).*(height, width, channel)"),
    "integers": ({"image": np.zeros((4, 5, 3), int)}, "scatter\\(image\\).*floats.*int64"),
    "depth shape": ({"depth": np.ones((5, 4))}, "scatter\\(depth\\).*\\(4, 5\\).*\\(5, 4\\)"),
    "depth kind": ({"depth": "far.exr"}, "scatter\\(depth\\)` must be an array, got 'far.exr'"),
    "gamma": ({"gamma": -1.0}, "scatter\\(gamma=...\\)"),
    "epsilon": ({"epsilon": -1.0}, "scatter\\(epsilon=...\\)"),
    "max_coc": ({"max_coc": -3}, "scatter\\(max_coc=...\\).*positive, got -3"),
    "program": ({"program": "best"}, "scatter\\(program=...\\).*segment_sum.*'best'"),
    "coverage": ({"coverage": "round"}, "scatter\\(coverage=...\\).*area.*'round'"),
    "indicator": ({"coverage": "indicator", "program": "shift"}, "segment_sum"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    change, message = BAD[case]
    arguments = {"image": np.ones((4, 5, 3)), "depth": np.ones((4, 5))} | change
    # The bare function: under test, jaxtyping would find a wrong shape first.
    with pytest.raises(ValueError, match=message):
        inspect.unwrap(dof.scatter)(**arguments, lens=ThinLens(0.1, 2.5, 60.0))


def test_max_coc_is_asked_for_under_transforms():
    image, depth = random_scene(16)
    lens = ThinLens(0.1, 2.5, 60.0)
    with pytest.raises(ValueError, match=r"max_coc=.*under `jit`"):
        jax.jit(dof.scatter)(image, depth, lens)
    with pytest.raises(ValueError, match=r"max_coc=.*under `jit`"):
        jax.grad(lambda a: dof.scatter(image, depth, ThinLens(a, 2.5, 60.0)).sum())(0.1)


def test_a_traced_bad_lens_gives_nan():
    image, depth = random_scene(17)
    blur = jax.jit(lambda a: dof.scatter(image, depth, ThinLens(a, 2.5, 60.0), max_coc=4))
    assert np.isnan(blur(-0.1)).all()
    assert np.isfinite(blur(0.1)).all()
