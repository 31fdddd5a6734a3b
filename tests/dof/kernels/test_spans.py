"""The spans where they differ from the others: large radii, several blocks, highlights."""

import functools as ft
import importlib

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof.kernels._shift import shift
from jaxfx.dof.kernels._spans import BLOCK, spans
from jaxfx.dof.kernels._tiles import tiles
from jaxfx.dof.sprites import Sprites
from tests.helpers.forms import first


REACH = 21
# Two blocks down and two across: one and a half would be one.
SHAPE = (BLOCK[0] * 3 // 2 + 3, BLOCK[1] * 3 // 2 + 5)
PROGRAMS = {"shift": shift, "tiles": tiles, "spans": spans}


def sprites(seed=0, shape=SHAPE, largest=2 * REACH, epsilon=1.7, dtype=np.float64):
    """Every share of large and small, before and behind the focus, over several blocks."""
    rng = np.random.default_rng(seed)
    coc = rng.uniform(0, largest, shape) ** rng.choice([0, 0.5, 1], shape)
    leak = np.where(rng.random(shape) < 0.3, -1.0, coc)
    radius = np.maximum(coc / 2, 0.5)
    value = rng.uniform(0.5, 1.0, (*shape, 3)) / (np.pi * radius * radius)[..., None]
    planes = (jnp.asarray(x, dtype) for x in (value, radius, leak, coc, epsilon))
    return Sprites(*planes)


@ft.cache
def sums_and_gradient(program):
    def loss(sprites):
        sums = PROGRAMS[program](sprites, REACH)
        weight = jnp.sin(jnp.arange(sums.size, dtype=sums.dtype) ** 2).reshape(sums.shape)
        return jnp.sum(weight * sums), sums

    return jax.jit(jax.value_and_grad(loss, has_aux=True))(sprites())


@pytest.mark.full
def test_many_blocks_have_the_same_sums():
    (_, expected), _ = sums_and_gradient("shift")
    (_, result), _ = sums_and_gradient("spans")
    np.testing.assert_allclose(result, expected, atol=1e-10)


@pytest.mark.parametrize("field", Sprites._fields)
@pytest.mark.full
def test_many_blocks_have_the_same_gradient(field):
    _, expected = sums_and_gradient("shift")
    _, result = sums_and_gradient("spans")
    assert np.abs(getattr(expected, field)).max() > 1e-4
    np.testing.assert_allclose(getattr(result, field), getattr(expected, field), atol=1e-8)


@ft.cache
def compiled(program):
    return jax.jit(lambda sprites: PROGRAMS[program](sprites, 64))


@hyp.given(st.integers(0, 2**32 - 1), st.floats(0.01, 12), st.floats(2, 128))
@hyp.settings(max_examples=10, deadline=None)
@pytest.mark.full
def test_kernels_agree_to_a_radius_of_64(seed, epsilon, largest):
    for dtype, tolerance in ((np.float64, 1e-13), (np.float32, 1e-4)):
        given = sprites(seed, (33, 41), largest, epsilon, dtype)
        expected = compiled("shift")(given)
        scale = np.asarray(expected[..., -1:])
        for program in ("tiles", "spans"):
            difference = (compiled(program)(given) - expected) / scale
            assert np.abs(difference).max() < tolerance, program


@pytest.mark.parametrize("bright", [1e2, 1e4, 1e6])
@first("share", [1, 40])
@pytest.mark.full
def test_highlights_leave_dim_pixels_alone(bright, share):
    rng = np.random.default_rng(3)
    given = sprites(4, (33, 41), 40.0, 1.0)
    lit = np.zeros(given.radius.shape, bool)
    lit.ravel()[rng.choice(lit.size, share, replace=False)] = True
    # All go to the left of a gap that no highlight reaches, along the same rows.
    lit &= (np.arange(41) + np.ceil(given.radius) < 30) & (np.asarray(given.radius) > 1.5)
    value = jnp.where(lit[..., None], bright, 1.0) * given.value
    exact = compiled("shift")(given._replace(value=value))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), given._replace(value=value))
    result = compiled("spans")(single)[:, 31:]
    np.testing.assert_allclose(result, exact[:, 31:], rtol=1e-3)


@first("program", PROGRAMS)
@pytest.mark.full
def test_the_order_of_pixels_is_irrelevant(program):
    # The image of all is the sum of the images of any parts, taken in any order.
    given = sprites(7, (33, 41), 30.0)
    part = np.random.default_rng(8).integers(0, 3, given.radius.shape)
    only = lambda k: given._replace(value=jnp.where((part == k)[..., None], given.value, 0))
    parts = [compiled(program)(only(k)) for k in (2, 0, 1)]
    np.testing.assert_allclose(sum(parts), compiled(program)(given), atol=1e-12)


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize(("program", "reach"), [("shift", 8), ("tiles", 8), ("spans", 64)])
@pytest.mark.full
def test_a_gradient_takes_at_most_24_pictures_of_memory(program, reach):
    shape = jax.ShapeDtypeStruct((512, 512, 3), jnp.float32)
    plane = jax.ShapeDtypeStruct((512, 512), jnp.float32)

    def loss(image, depth, aperture):
        lens = ThinLens(aperture, 2.5, 60.0)
        blurred = dof.scatter(image, depth, lens, gamma=2.0, max_coc=2 * reach, program=program)
        return jnp.sum(blurred**2)

    single = jax.ShapeDtypeStruct((), jnp.float32)
    # Memory is assigned before machine code is optimised.
    options = {"xla_backend_optimization_level": 0}
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    compiled = gradient.lower(shape, plane, single).compile(compiler_options=options)
    assert compiled.memory_analysis().temp_size_in_bytes < 24 * shape.size * 4


def test_the_leak_rejection_splits_at_three_epsilon():
    rng = np.random.default_rng(5)
    epsilon = rng.uniform(0.1, 4, 10_000)
    p, q = rng.uniform(3, 40, 10_000) * epsilon, rng.uniform(0, 40, 10_000) * epsilon
    sharp = 1 - np.clip(q / epsilon - 1, 0, 1)
    whole = 1 - sharp * np.clip((p - q) / epsilon, 0, 1)
    np.testing.assert_array_equal(whole, 1 - sharp)


def test_the_cost_model_knows_who_is_quickest_where():
    module = importlib.import_module("jaxfx.dof.scatter")
    assert module.cheapest(64, 64, 8) == "shift"
    assert module.cheapest(512, 512, 8) == module.cheapest(512, 512, 16) == "tiles"
    # Tiles go on by whole runs of taps: from the first on, spans are quicker.
    assert module.cheapest(512, 512, 18) == "spans"
    assert module.cheapest(512, 512, 24) == module.cheapest(1024, 1024, 64) == "spans"


@pytest.mark.full
def test_auto_looks_at_the_data_where_it_can(monkeypatch):
    module = importlib.import_module("jaxfx.dof.scatter")
    asked = []
    monkeypatch.setattr(
        module, "cheapest", lambda *size: asked.append(size) or "shift", raising=True
    )
    image, depth, lens = jnp.ones((5, 6, 1)), jnp.full((5, 6), 4.0), ThinLens(0.1, 2.0, 80.0)
    blur = lambda depth: dof.scatter(image, depth, lens, max_coc=9)
    blur(depth)
    jax.jit(blur)(depth)
    jax.jit(lambda gamma: dof.scatter(image, depth, lens, max_coc=9, gamma=gamma))(1.0)
    jax.jit(lambda i: dof.scatter(i, depth, lens))(image)
    largest = float(lens.circle_of_confusion(depth)[0, 0])
    assert asked == [(5, 6, largest), (5, 6, 9), (5, 6, largest), (5, 6, largest)]


@first("program", ["segment_sum", "shift", "tiles", "spans", "rows"])
@pytest.mark.full
def test_solvers_run_on_every_kernel(program):
    rng = np.random.default_rng(6)
    image = jnp.asarray(rng.random((12, 11, 1)))
    depth = jnp.asarray(rng.uniform(1.2, 6, (12, 11)))

    def residual(aperture, reference):
        lens = ThinLens(aperture, 2.5, 60.0)
        blurred = dof.scatter(image, depth, lens, epsilon=0.7, max_coc=8, program=program)
        return blurred - reference

    tolerance = {"rtol": 1e-6, "atol": 1e-8}
    loss = lambda aperture, reference: jnp.sum(residual(aperture, reference) ** 2)

    @jax.jit
    def solved(start, reference):
        solvers = optx.LevenbergMarquardt(**tolerance), optx.BFGS(**tolerance)
        options = {"args": reference, "throw": False}
        fitted = optx.least_squares(residual, solvers[0], start, **options).value
        least = optx.minimise(loss, solvers[1], start, **options).value
        _, push = jax.linearize(lambda aperture: residual(aperture, 0.0), start)
        return fitted, least, push(jnp.ones(()))

    start, seen = jnp.asarray(0.1), jax.jit(lambda aperture: residual(aperture, 0.0))
    fitted, least, pushed = solved(start, seen(jnp.asarray(0.12)))
    assert fitted == pytest.approx(0.12, rel=1e-4)
    assert least == pytest.approx(0.12, rel=1e-4)
    steps = [seen(start + h) for h in (1e-6, -1e-6)]
    np.testing.assert_allclose(pushed, (steps[0] - steps[1]) / 2e-6, rtol=1e-6, atol=1e-6)
