"""Both flows of heat against dense linear algebra, Gaussians and counts of work."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens, dof


METHODS = [dof.anisotropic_diffusion, dof.implicit_diffusion]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)
LENSES = [ThinLens(0.3, 3.0, 60.0), FocusPlanes(1.0, 3.0, 8.0, 9.0)]


def scene(seed=0, height=7, width=9):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.5, 10.0, (height, width))
    depth[rng.random((height, width)) < 0.2] = np.inf
    return rng.random((height, width, 2)), depth


def clamped(lens, depth, max_coc):
    return np.clip(np.asarray(lens.defocus(jnp.asarray(depth))), -max_coc, max_coc)


def laplacian(defocus, edge, axes):
    """The dense matrix of `div(g grad u)`, border by border."""
    number = np.arange(defocus.size).reshape(defocus.shape)
    matrix = np.zeros((defocus.size,) * 2)
    for axis in axes:
        pairs = zip(
            np.delete(number, -1, axis).ravel(), np.delete(number, 0, axis).ravel(), strict=True
        )
        for p, q in pairs:
            one, other = defocus.ravel()[[p, q]]
            g = min(one**2, other**2) / 32 / (1 + ((one - other) / edge) ** 2)
            matrix[p, [p, q]] += [-g, g]
            matrix[q, [p, q]] += [g, -g]
    return matrix


@pytest.mark.parametrize("lens", LENSES, ids=["thin", "planes"])
def test_implicit_is_two_dense_solves(lens):
    image, depth = scene()
    defocus = clamped(lens, depth, 9.0)
    flat = image.reshape(-1, 2)
    for axis in (1, 0):
        flat = np.linalg.solve(np.eye(len(flat)) - laplacian(defocus, 1.5, [axis]), flat)
    result = dof.implicit_diffusion(image, depth, lens, max_coc=9.0, edge=1.5)
    np.testing.assert_allclose(result, flat.reshape(image.shape), atol=1e-12)


@pytest.mark.parametrize("lens", LENSES, ids=["thin", "planes"])
def test_anisotropic_is_so_many_dense_steps(lens):
    image, depth = scene()
    steps = 12  # ceil(81 / 8) = 11, as 3 times 4
    flow = laplacian(clamped(lens, depth, 9.0), 1.5, [0, 1]) / steps
    flat = np.linalg.matrix_power(np.eye(len(flow)) + flow, steps) @ image.reshape(-1, 2)
    result = dof.anisotropic_diffusion(image, depth, lens, max_coc=9.0, edge=1.5)
    np.testing.assert_allclose(result, flat.reshape(image.shape), atol=1e-12)


@each_method
@pytest.mark.parametrize("radius", [1.0, 4.0])
def test_a_point_of_light_has_the_variance_of_its_disc(method, radius):
    size, middle = 81, 40
    image = np.zeros((size, size, 1))
    image[middle, middle] = 1
    lens = ThinLens(1.0, 1.0, 2 * radius)
    spread = np.asarray(method(image, np.full((size, size), np.inf), lens, max_coc=8))[..., 0]
    offset = np.arange(size) - middle
    assert spread.sum() == pytest.approx(1, abs=1e-12)
    assert (spread * offset).sum() == pytest.approx(0, abs=1e-9)
    for axis_offset in (offset, offset[:, None]):
        assert (spread * axis_offset**2).sum() == pytest.approx(radius**2 / 4, rel=1e-6)


@each_method
def test_energy_is_kept_and_nothing_rings(method):
    image, depth = scene(1, 12, 15)
    result = np.asarray(method(image, depth, LENSES[0], max_coc=9))
    np.testing.assert_allclose(result.sum(axis=(0, 1)), image.sum(axis=(0, 1)), rtol=1e-12)
    assert result.min() >= image.min()
    assert result.max() <= image.max()


@each_method
def test_nothing_flows_into_focus_or_past_a_bad_pixel(method):
    image, depth = scene(2, 12, 15)
    depth[:, 7] = 3.0  # a wall in focus
    changed = image.copy()
    changed[:, 8:] = 100.0
    call = jax.jit(lambda *a: method(*a, LENSES[0], max_coc=9))
    result = call(image, depth)
    np.testing.assert_allclose(result[:, 7], image[:, 7], atol=1e-12)
    np.testing.assert_array_equal(call(changed, depth)[:, :8], result[:, :8])
    for bad_image, bad_depth in ((np.nan, 9.0), (np.inf, 9.0), (np.nan, np.nan)):
        image[4, 3], depth[4, 3] = bad_image, bad_depth
        wrong = np.argwhere(np.isnan(call(image, depth)).any(axis=-1))
        np.testing.assert_array_equal(wrong, [[4, 3]])


@pytest.mark.usefixtures("optimised")
def test_implicit_work_does_not_grow_with_the_radius():
    def operations(max_coc):
        call = jax.jit(lambda *a: dof.implicit_diffusion(*a, LENSES[0], max_coc=max_coc))
        image, depth = scene(0, 16, 16)
        compiled = call.lower(jnp.asarray(image), jnp.asarray(depth)).compile()
        return compiled.cost_analysis()["flops"], compiled.as_text().count(" = ")

    assert operations(4.0) == operations(400.0)


def test_implicit_keeps_its_digits_at_any_radius():
    """Pivots by subtraction lose what 1 is to a conductance of 1e6."""
    image = np.full((3, 200, 1), 0.7, np.float32)
    lens = ThinLens(1.0, 1.0, 6000.0)
    call = lambda image: dof.implicit_diffusion(
        image, np.full((3, 200), np.inf, np.float32), lens, max_coc=6000
    )
    np.testing.assert_allclose(call(image), 0.7, atol=2e-6)
    image[1, 50] = 100
    exact = call(image.astype(np.float64))
    np.testing.assert_allclose(call(image), exact, rtol=2e-5)


@pytest.mark.usefixtures("optimised")
@pytest.mark.full
def test_explicit_memory_of_a_gradient_grows_with_the_root_of_the_steps():
    image, depth = scene(0, 32, 32)

    def memory(max_coc):
        loss = lambda image, lens: dof.anisotropic_diffusion(
            image, depth, lens, max_coc=max_coc
        ).sum()
        gradient = jax.jit(jax.grad(loss, argnums=1))
        stats = gradient.lower(jnp.asarray(image), LENSES[0]).compile().memory_analysis()
        return stats.temp_size_in_bytes

    # 16 times the steps, 4 times the states.
    assert memory(64.0) < 6 * memory(16.0)


@each_method
def test_an_edge_that_is_not_positive_is_named(method):
    image, depth = scene()
    with pytest.raises(ValueError, match=rf"`{method.__name__}\(edge=...\)` must be positive"):
        inspect.unwrap(method)(image, depth, LENSES[0], edge=0.0)


def test_fewest_stable_steps():
    """A checkerboard is what an unstable step blows up first."""
    image = np.indices((16, 16)).sum(axis=0)[..., None] % 2.0
    for max_coc in (0.5, 3.0, 11.0):
        lens = ThinLens(1.0, 1.0, max_coc)
        result = dof.anisotropic_diffusion(
            image, np.full((16, 16), np.inf), lens, max_coc=max_coc
        )
        assert 0 <= np.min(result) <= np.max(result) <= 1
        assert math.isclose(np.mean(result), 0.5)
