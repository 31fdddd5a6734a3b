"""All methods of depth of field in one run: 512 x 512 x 3 float32, radius 8 and 32.

`pytest --benchmark-only benchmarks/test_family_speed.py` prints a group for each radius
with medians, spread and the ratios to the quickest; and the gradients at radius 8.
"""

import jax
import jax.numpy as jnp
import pytest

from benchmarks.scenes import discs, dof as dof_cases


METHODS = dof_cases.methods()


def program(name, radius):
    image, depth, lens = discs.two_discs(512, radius)
    method = lambda image, lens: METHODS[name](image, depth, lens, max_coc=2.0 * radius)
    return method, jnp.asarray(image), lens


@pytest.mark.parametrize("radius", [8, 32])
@pytest.mark.parametrize("name", METHODS)
def test_forward(benchmark, name, radius):
    benchmark.group = f"radius {radius}"
    method, *data = program(name, radius)
    picture = jax.jit(method)
    run = lambda: jax.block_until_ready(picture(*data))
    benchmark.pedantic(run, rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("name", METHODS)
def test_gradient(benchmark, name):
    benchmark.group = "gradient in the image and the lens, radius 8"
    method, *data = program(name, 8)
    loss = lambda image, lens: jnp.sum(method(image, lens) ** 2)
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))
    run = lambda: jax.block_until_ready(gradient(*data))
    benchmark.pedantic(run, rounds=5, warmup_rounds=1)
