"""Layered scatter beside scatter, in one run: 512 x 512 x 3 float32.

`pytest --benchmark-only tests/benchmarks` prints each group with the ratios to its quickest.
"""

import functools

import jax
import jax.numpy as jnp
import pytest
import scenes

from jaxfx import dof


METHODS = {
    "scatter, auto": functools.partial(dof.scatter, gamma=2.0, epsilon=2.0),
    "scatter, tiles": functools.partial(dof.scatter, gamma=2.0, epsilon=2.0, kernel="tiles"),
    "one layer": dof.layered,
    "two layers": dof.layered,
}


@pytest.mark.parametrize("radius", [8, 16])
@pytest.mark.parametrize("method", METHODS)
def test_forward(benchmark, method, radius):
    benchmark.group = f"layered, radius {radius}"
    image, depth, lens = scenes.two_discs(512, radius)
    image, depth = jnp.asarray(image), jnp.asarray(depth)
    options = {"max_coc": 2.0 * radius}
    if method == "two layers":
        # The wall goes on behind both discs.
        options["behind"] = image[::-1], jnp.where(depth < 4, 4, jnp.inf)
    call = functools.partial(METHODS[method], image, depth, lens, **options)
    benchmark.pedantic(lambda: jax.block_until_ready(call()), rounds=5, warmup_rounds=1)
