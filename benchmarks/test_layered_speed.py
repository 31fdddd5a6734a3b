"""Layered scatter beside scatter, in one run: 512 x 512 x 3 float32.

`pytest --benchmark-only benchmarks` prints each group with the ratios to its quickest.
One layer is asked to take at most 4 times what scatter takes.
"""

import functools

import jax
import jax.numpy as jnp
import pytest

from benchmarks.scenes import discs
from jaxfx import ThinLens, dof


METHODS = {
    "scatter, auto": functools.partial(dof.scatter, gamma=2.0, epsilon=2.0),
    "one layer": functools.partial(dof.layered, behind=None),
    "two layers": dof.layered,
}


def case(method, radius):
    """The method as a function of an image and an aperture, and these."""
    image, depth, lens = discs.two_discs(512, radius)
    image, depth = jnp.asarray(image), jnp.asarray(depth)
    options = {"max_coc": 2.0 * radius}
    if method == "two layers":
        # The wall goes on behind both discs.
        options["behind"] = image[::-1], jnp.where(depth < 4, 4, jnp.inf)

    def picture(image, aperture):
        seen = ThinLens(aperture, lens.focus_distance, lens.focal_pixels)
        return METHODS[method](image, depth, seen, **options)

    return picture, (image, lens.aperture)


@pytest.mark.parametrize("radius", [8, 16, 32])
@pytest.mark.parametrize("method", METHODS)
def test_forward(benchmark, method, radius):
    benchmark.group = f"layered, radius {radius}"
    picture, at = case(method, radius)
    call = jax.jit(picture)
    benchmark.pedantic(lambda: jax.block_until_ready(call(*at)), rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("radius", [8, 32])
@pytest.mark.parametrize("what", ["forward", "gradient"])
def test_gradient(benchmark, what, radius):
    """With respect to the image and the aperture; forward is the value alone."""
    benchmark.group = f"layered, gradient, radius {radius}"
    picture, at = case("one layer", radius)
    loss = lambda *at: jnp.sum(picture(*at) ** 2)
    call = jax.jit(loss if what == "forward" else jax.grad(loss, (0, 1)))
    benchmark.pedantic(lambda: jax.block_until_ready(call(*at)), rounds=3, warmup_rounds=1)
