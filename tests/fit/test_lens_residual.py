"""The report of a lens' residual: derivatives by difference quotients, and what it drew."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxfx import ThinLens
from jaxfx.fit import _lens_arguments as read
from jaxfx.fit._lens_model import Model, missing_blur
from jaxfx.fit._lens_residual import plain, report
from tests.helpers.forms import first


SIDE, STEP = 16, 1e-6
ALL = ("aperture", "focus_distance", "gamma", "epsilon", "footprint")


def case(names):
    """The residual of two photographs in the parameters `names`, and unknowns beside 0."""
    rng = np.random.default_rng(0)
    image = rng.random((SIDE, SIDE, 2))
    depth = np.broadcast_to(np.linspace(1.7, 4.3, SIDE), (SIDE, SIDE))
    lenses = [ThinLens(jnp.asarray(0.2), jnp.asarray(focus), 60.0) for focus in (2.5, 3.5)]
    photographs = [rng.random((SIDE, SIDE, 2)) for _ in lenses]
    images, lenses = read.images(photographs, image, depth, lenses, None, None)
    start = read.start(lenses, None, 1.0, 2.0, 2.0, images.image.dtype)
    model = Model(images, start, jnp.ones(()), None, names, "scatter", 8.0)
    unknowns = {name: jnp.full(start[name].shape, 0.03) for name in names}
    return plain(model, exposure=False, tone="linear"), unknowns


def quotient(function):
    """The central difference quotient at 0 of a function of one number."""
    ahead, behind = np.asarray(function(STEP)), np.asarray(function(-STEP))
    return (ahead - behind).reshape(-1) / (2 * STEP)


@first("names", [ALL, ("focus_distance", "gamma", "footprint")])
def test_columns_and_widening_are_difference_quotients(names):
    residual, unknowns = case(names)
    reported = report(residual, unknowns)
    flat, unravel = ravel_pytree(unknowns)
    value = jax.jit(lambda flat: residual(unravel(flat)))
    for column, axis in zip(np.asarray(reported.columns).T, np.eye(flat.size), strict=True):
        along = lambda step, axis=axis: value(np.asarray(flat) + step * axis)
        np.testing.assert_allclose(column, quotient(along), rtol=1e-5, atol=1e-7)
    start = residual.model.start
    factor = residual.model.values(unknowns)["aperture"] / start["aperture"]

    @jax.jit
    def widened(step):
        """By a model whose apertures start wider, and are not sought."""
        wide = start | {"aperture": start["aperture"] * factor * jnp.exp(step)}
        held = tuple(name for name in names if name != "aperture")
        model = Model(residual.model.images, wide, jnp.ones(()), None, held, "scatter", 8.0)
        rest = {name: unknowns[name] for name in held}
        return plain(model, exposure=False, tone="linear")(rest)

    np.testing.assert_allclose(reported.widening, quotient(widened), rtol=1e-5, atol=1e-7)


def test_a_report_tells_what_was_drawn_with_and_without_the_footprint():
    residual, unknowns = case(ALL)
    model = residual.model
    reported = report(residual, unknowns)
    _, drawn, corrected, gain, offset = reported.compared

    @jax.jit
    def with_footprint(unknowns):
        values = model.values(unknowns)
        added = jax.vmap(missing_blur)(drawn, model.circles(values))
        return drawn + values["footprint"] * added

    np.testing.assert_allclose(corrected, with_footprint(unknowns), rtol=1e-12)
    np.testing.assert_array_equal(gain, np.ones((2, 2)))
    np.testing.assert_array_equal(offset, np.zeros((2, 2)))
    expected = np.asarray(corrected) - np.asarray(model.images.references)
    np.testing.assert_allclose(reported.residual, expected, rtol=1e-12, atol=1e-15)
