"""Fits of a batch of frames or starts, as one program, against one after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxfx import ThinLens, fit
from jaxfx.fit import _lens_model
from tests.helpers.fits import CAMERA, DEPTH, FITS, LENS


IMAGE = np.ones((12, 12, 1))


def assert_equal(found, expected):
    """Equal to rounding, verdicts and all; losses up to where the search ended."""
    steps = expected.losses.size
    np.testing.assert_allclose(found.losses[:steps], expected.losses, rtol=1e-6, atol=1e-12)
    assert np.isnan(found.losses[steps:]).all()
    assert found.doubt == expected.doubt
    leaves = [jax.tree.leaves({**vars(fitted), "losses": 0}) for fitted in (found, expected)]
    for one, other in zip(*leaves, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("name", FITS)
def test_a_batch_of_fits_is_a_loop(name):
    fitted, data = FITS[name](2)
    batch = jax.jit(jax.vmap(fitted))(*data)
    for at in range(2):
        one = jax.tree.map(lambda leaf, at=at: leaf[at], batch)
        assert_equal(one, fitted(*(each[at] for each in data)))


class Shrunk(Exception):
    """Raised in place of a search, with the factor by which its first images are smaller."""


def test_a_search_begins_at_the_same_size_under_a_transform_and_outside(monkeypatch):
    """The start's circles of confusion, of some 5 pixels, would ask for no smaller images."""

    def shrunk(images, factor):
        raise Shrunk(factor)

    monkeypatch.setattr(_lens_model.Images, "shrunk", shrunk)
    image = np.random.default_rng(0).random((8, 320, 1))
    depth = np.broadcast_to(np.linspace(2.0, 4.0, 320), (8, 320))
    options = {"max_coc": 20.0, "throw": False}
    search = lambda aperture: fit.dof(image, image, depth, ThinLens(aperture, 3, 40), **options)
    for call in (search, jax.jit(search)):
        with pytest.raises(Shrunk) as caught:
            call(jnp.asarray(0.5))
        assert caught.value.args == (2,)


def test_what_a_search_under_a_transform_can_not_do_is_refused():
    with pytest.raises(ValueError, match=r"dof\(max_coc=...\).* under `jit` and `vmap`"):
        jax.jit(lambda a: fit.dof(IMAGE, IMAGE, DEPTH, ThinLens(a, 3.0, 40.0)))(jnp.ones(()))
    with pytest.raises(ValueError, match=r"dof\(throw=...\).* False under `jit` and `vmap`"):
        jax.jit(lambda image: fit.dof(image, image, DEPTH, LENS, max_coc=4))(IMAGE)
    shown = lambda image: fit.camera(
        image, image, DEPTH, CAMERA, CAMERA, throw=False, progress=True
    )
    with pytest.raises(ValueError, match=r"camera\(progress=...\).* got True"):
        jax.jit(shown)(IMAGE)


def test_a_solver_inside_shard_map_is_refused_by_name():
    auto = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((1,), ("frames",), axis_types=auto)
    spec = jax.sharding.PartitionSpec("frames")
    options = {"solver": optx.GaussNewton(rtol=1e-4, atol=1e-4), "throw": False}
    fitted = jax.vmap(
        lambda image: fit.camera(image, image, DEPTH, CAMERA, CAMERA, **options).share
    )
    named = r"camera\(solver=...\).* `jax.shard_map`.* `jit\(vmap.* got GaussNewton"
    with pytest.raises(ValueError, match=named):
        jax.eval_shape(
            jax.shard_map(fitted, mesh=mesh, in_specs=spec, out_specs=spec), IMAGE[None]
        )
