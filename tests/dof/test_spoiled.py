"""What bad pixels spoil, and that a batch computes it only where there are any."""

import contextlib
import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof
from jaxfx.dof import spoiled as spoiled_module
from jaxfx.dof.spoiled import spoiled
from tests.helpers.forms import first
from tests.helpers.programs import primitives
from tests.helpers.quick import for_accelerators


LENS = ThinLens(0.1, 2.5, 200.0)
METHODS = {
    "scatter": ft.partial(dof.scatter, max_coc=7.0),
    "layered": ft.partial(dof.layered, max_coc=7.0),
    "depth_sorted": ft.partial(dof.depth_sorted, max_coc=7.0, slices=2),
}


def discs(bad, diameter, margin):
    """Pixels with a point within `margin` of their centre in a disc about a bad pixel's."""
    y, x = np.mgrid[: bad.shape[0], : bad.shape[1]]
    found = np.zeros(bad.shape, bool)
    for j, i in np.argwhere(bad):
        down, across = (np.maximum(each - margin, 0) for each in (abs(y - j), abs(x - i)))
        found |= np.hypot(down, across) < max(diameter[j, i] / 2, 0.5)
    return found


@pytest.mark.parametrize("on", [contextlib.nullcontext, for_accelerators])
@pytest.mark.parametrize("max_coc", [5.0, 40.0])
def test_it_is_what_their_discs_overlap(max_coc, on):
    """All pixels whose centre lies in a disc, and none beside it; of no number the largest.

    On a CPU the wide one is counted by tiles.
    """
    rng = np.random.default_rng(0)
    coc = rng.uniform(0, 12, (70, 60))
    bad = rng.random((70, 60)) < 0.002
    coc[*np.argwhere(bad)[0]], coc[*np.argwhere(bad)[1]] = np.nan, np.inf
    diameter = np.where(coc < max_coc, coc, max_coc)
    with on():
        found = np.asarray(spoiled(jnp.asarray(bad), jnp.asarray(coc), max_coc))
    assert found[discs(bad, diameter, 0)].all()
    assert not found[~discs(bad, diameter, 0.5)].any()
    assert not found.all()


@first("name", METHODS)
@pytest.mark.parametrize("transform", ["jit", "vmap", "grad of vmap"])
@pytest.mark.full
def test_a_batch_computes_it_in_a_branch_alone(name, transform, monkeypatch):
    """The cover is marked by an operation that nothing else has."""
    real = spoiled_module.sum_all
    marked = lambda value, radius, reach: jnp.sinh(real(value, radius, reach))
    monkeypatch.setattr(spoiled_module, "sum_all", marked)
    jax.clear_caches()
    method = lambda image, depth: METHODS[name](image, depth, LENS)
    run = {
        "jit": method,
        "vmap": jax.vmap(method),
        "grad of vmap": jax.grad(lambda *data: jnp.sum(jax.vmap(method)(*data)), (0, 1)),
    }[transform]
    batch = () if transform == "jit" else (3,)
    data = jnp.ones((*batch, 9, 8, 1)), jnp.full((*batch, 9, 8), 3.0)
    program = jax.make_jaxpr(run)(*data).jaxpr
    jax.clear_caches()
    assert "sinh" in set(primitives(program))
    assert "sinh" not in set(primitives(program, skip=("cond",)))


@first("name", METHODS)
@pytest.mark.full
def test_one_bad_image_of_a_batch_spoils_itself_alone(name):
    rng = np.random.default_rng(1)
    image, depth = rng.random((3, 12, 14, 2)), rng.uniform(2, 9, (3, 12, 14))
    image[1, 6, 7] = np.nan
    batch = jax.vmap(lambda image, depth: METHODS[name](image, depth, LENS))(image, depth)
    for each, alone in zip(batch, zip(image, depth, strict=True), strict=True):
        single = METHODS[name](*alone, LENS)
        np.testing.assert_allclose(each, single, rtol=1e-9, atol=1e-12)
    assert np.isnan(batch[1]).any(axis=-1).sum() in range(1, 60)
    assert np.isfinite(batch[::2]).all()
