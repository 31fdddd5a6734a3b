"""The search: its steps, its surfaces, its derivatives. Its hits, and where the quick methods
fail, are held to a walk over every texel in `tests/stability`."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes.reproject import run, slanted_rays
from jaxfx.reproject import _traversal, intersect
from tests.cases.reproject import awkward_rays, field, grid_walk
from tests.helpers.forms import first


METHODS = ("pyramid", "descent", "linear", "relief")


def check_exact(hit, depth, origin, direction, tolerance):
    known = np.where(depth > 0, depth, np.inf).astype(float)
    found = 0
    for k in range(len(origin)):
        o, d = origin[k].astype(float), direction[k].astype(float)
        expected = grid_walk(known, o, d)
        assert bool(hit.mask[k]) == (expected is not None), (o, d)
        if expected is not None:
            place = o + expected[0] * d
            np.testing.assert_allclose(hit.position[k], place, rtol=0, atol=tolerance)
            found += 1
    return found


@pytest.mark.parametrize(("count", "together"), [(9000, _traversal._BATCH_RAYS), (9001, 4000)])
@pytest.mark.full
def test_many_rays_go_on_in_parts_and_thirds(count, together, monkeypatch):
    # Of another number, or JAX would take the program that it has traced before.
    monkeypatch.setattr(_traversal, "_BATCH_RAYS", together)
    rng = np.random.default_rng(5)
    depth = field((64, 64), rng)
    origin = rng.uniform((0, 0, 0), (64, 64, 0.1), (count, 3))
    direction = rng.normal(size=(count, 3)) * (64, 64, 1)
    hit = run(depth, origin, direction)
    pick = np.append(rng.choice(count, 600, replace=False), count - 1)
    some = jax.tree.map(lambda x: x[pick], hit)
    assert check_exact(some, depth, origin[pick], direction[pick], 1e-9) > 100


@pytest.mark.full
def test_under_vmap_every_ray_finds_the_same_in_as_many_steps():
    rng = np.random.default_rng(6)
    depths = np.stack([field((17, 13), rng) for _ in range(3)])
    origin, direction = awkward_rays((17, 13), rng, 30)
    both = jax.vmap(lambda d: run(d, origin, direction))(depths)
    rays = jax.vmap(lambda o, d: run(depths[0], o, d))(origin, direction)
    for k, depth in enumerate(depths):
        one = run(depth, origin, direction)
        jax.tree.map(
            np.testing.assert_array_equal, jax.tree.map(lambda x, k=k: x[k], both), one
        )
        if k == 0:
            jax.tree.map(np.testing.assert_array_equal, rays, one)


@pytest.mark.parametrize("method", METHODS)
def test_a_vertical_ray_meets_its_texel(method):
    depth = np.random.default_rng(0).uniform(0.2, 1, (5, 7))
    y, x = np.mgrid[:5, :7] + 0.5
    origin = np.stack([x, y, np.zeros_like(x)], axis=-1)
    direction = np.broadcast_to([0.0, 0.0, 2.0], origin.shape)
    hit = run(depth, origin, direction, search=method)
    assert hit.mask.all()
    # Relief mapping ends within its last halving.
    tolerance = 2e-4 if method == "relief" else 1e-12
    np.testing.assert_allclose(hit.position, np.stack([x, y, depth], -1), atol=tolerance)


# The bilinear surface, and derivatives.


def plane(size):
    y, x = np.mgrid[:size, :size] + 0.5
    return 0.3 + 0.02 * x + 0.01 * y


def test_bilinear_meets_a_plane_where_it_is():
    origin, direction = slanted_rays(32, 2)
    hit = run(plane(32), origin, direction, surface="bilinear")
    x, y, z = np.moveaxis(np.asarray(hit.position), -1, 0)
    inner = np.asarray(hit.mask) & (np.minimum(x, y) > 2) & (np.maximum(x, y) < 30)
    assert inner.sum() > 300 and not hit.grazing[inner].any()
    np.testing.assert_allclose(z[inner], (0.3 + 0.02 * x + 0.01 * y)[inner], atol=1e-9)


@first("surface", ["texel", "bilinear"])
@pytest.mark.full
def test_the_derivative_is_that_of_the_closed_form(surface):
    """A ray on a texel's top or on a plane: t = (D - z) / dz, or (D(o) - z) / (dz - D' d)."""
    depth, origin = jnp.asarray(plane(8)), jnp.array([4.3, 4.1, 0.0])
    direction = jnp.array([0.01, -0.02, 1.0])
    time = lambda depth, o, d: run(depth, o, d, surface=surface).position[2]
    if surface == "texel":
        expected = lambda depth, o, d: depth[4, 4] + 0 * jnp.sum(o * d)
    else:

        def expected(depth, o, d):
            slope_x, slope_y = depth[4, 4] - depth[4, 3], depth[4, 4] - depth[3, 4]
            at = depth[3, 3] + slope_x * (o[0] - 3.5) + slope_y * (o[1] - 3.5)
            t = (at - o[2]) / (d[2] - slope_x * d[0] - slope_y * d[1])
            return o[2] + t * d[2]

    arguments = depth, origin, direction

    @jax.jit
    def derivatives(*arguments):
        (found, ours), (wanted, theirs) = (
            jax.value_and_grad(of, argnums=(0, 1, 2))(*arguments) for of in (time, expected)
        )
        pushed = jax.jvp(lambda *x: time(depth, *x), arguments[1:], (direction, origin))[1]
        return (found, *ours), (wanted, jnp.sum(theirs[0]), *theirs[1:]), pushed

    (found, moved, *ours), (wanted, total, *theirs), pushed = derivatives(*arguments)
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    np.testing.assert_allclose(
        pushed, jnp.dot(theirs[0], direction) + jnp.dot(theirs[1], origin), atol=1e-9
    )
    # In depth itself: the shares of the four texels, or the one texel alone.
    assert float(jnp.sum(moved)) == pytest.approx(float(total), abs=1e-9)


@pytest.mark.full
def test_a_hit_on_a_side_moves_with_the_ray_and_not_with_depth():
    depth = jnp.where(jnp.arange(6)[None] < 3, 0.9, 0.2) * jnp.ones((6, 1))
    origin, direction = jnp.array([0.5, 2.5, 0.0]), jnp.array([4.0, 1.0, 1.0])
    hit = lambda depth, o: run(depth, o, direction).position
    np.testing.assert_allclose(hit(depth, origin), [3.0, 2.5 + 0.625, 0.625])
    np.testing.assert_allclose(
        jax.jacobian(hit, argnums=1)(depth, origin),
        [[0, 0, 0], [-0.25, 1, 0], [-0.25, 0, 1]],
        atol=1e-12,
    )
    assert not jax.jacobian(hit)(depth, origin).any()


@pytest.mark.full
def test_a_miss_and_a_slanting_ray_have_finite_derivatives():
    depth = jnp.full((4, 4), 0.5)
    origin = jnp.array([[9.0, 9.0, 0.0], [0.2, 0.2, 0.5], [1.0, 1.0, 0.7]])
    direction = jnp.array([[1.0, 0.0, 1.0], [1.0, 0.5, 0.0], [0.5, 0.5, -1.0]])
    for surface in ("texel", "bilinear"):
        hit = run(depth, origin, direction, surface=surface)
        np.testing.assert_array_equal(hit.mask, [False, True, True])
        total = lambda *x, surface=surface: jnp.sum(run(*x, surface=surface).position)
        moved = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(depth, origin, direction)
        assert all(np.isfinite(m).all() for m in moved)


FAULTS = {
    "intersect(depth)": {"depth": np.ones(3)},
    "intersect(origin)": {"origin": np.ones((4, 2))},
    "intersect(direction)": {"direction": np.ones((5, 3))},
    "intersect(search=...)": {"search": "fast"},
    "intersect(surface=...)": {"surface": "smooth"},
    "intersect(max_steps=...)": {"max_steps": 0},
}


@pytest.mark.parametrize(("name", "fault"), FAULTS.items(), ids=FAULTS)
def test_bad_arguments_are_named(name, fault):
    given = {"depth": np.ones((3, 3)), "origin": np.ones((4, 3)), "direction": np.ones((4, 3))}
    with pytest.raises(ValueError, match=re.escape(f"`{name}`")):
        inspect.unwrap(intersect)(**given | fault)
