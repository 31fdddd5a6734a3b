"""Scatter against native code, in one run: 512 x 512 x 3 float32, gamma 2, epsilon 2.

`pytest --benchmark-only benchmarks` prints each group with its medians, its spread and
the ratios to its quickest. The floor: 512 * 512 sprites, 12 operations and 4 channels a tap.
"""

import time

import jax
import jax.numpy as jnp
import pytest

from benchmarks.native import scatter as native
from benchmarks.scenes import discs
from jaxfx import ThinLens, dof


OPTIONS = {"gamma": 2.0, "epsilon": 2.0}


def waited(function, *arguments):
    return lambda: jax.block_until_ready(function(*arguments))


def run(benchmark, function):
    benchmark.pedantic(function, rounds=9, warmup_rounds=1)


def program(name, radius, scene):
    image, depth, lens = scene
    scatter = jax.jit(
        lambda image, lens: dof.scatter(
            image, depth, lens, max_coc=2.0 * radius, program=name, **OPTIONS
        )
    )
    return scatter, jnp.asarray(image), lens


@pytest.mark.parametrize("radius", [8, 32])
@pytest.mark.parametrize("method", ["native", "shift", "tiles", "spans", "auto"])
def test_forward(benchmark, method, radius):
    if (method, radius) == ("shift", 32):
        pytest.skip("some 2 seconds a call: its place is shown at radius 8")
    benchmark.group = f"radius {radius}"
    scene = discs.two_discs(512, radius)
    if method == "native":
        image, depth, lens = scene
        run(benchmark, lambda: native.scatter(image, depth, lens, 2.0, 2.0))
    else:
        run(benchmark, waited(*program(method, radius, scene)))


@pytest.mark.parametrize("method", ["segment_sum", "auto"])
def test_oracle(benchmark, method):
    benchmark.group = "the oracle, 256 x 256, radius 8"
    run(benchmark, waited(*program(method, 8, discs.two_discs(256, 8))))


@pytest.mark.parametrize("focus", ["blurred", "sharp"])
def test_in_focus(benchmark, focus):
    benchmark.group = "room for radius 8, blurred or wholly in focus"
    image, depth, lens = discs.two_discs(512, 8)
    depth = jnp.full_like(depth, lens.focus_distance) if focus == "sharp" else depth
    # The depth is traced: what is in focus is known at run time only.
    scatter = jax.jit(lambda *x: dof.scatter(*x, max_coc=16.0, **OPTIONS))
    run(benchmark, waited(scatter, jnp.asarray(image), jnp.asarray(depth), lens))


@pytest.mark.parametrize("mode", ["forward", "jvp", "grad"])
@pytest.mark.parametrize(("method", "radius"), [("shift", 8), ("tiles", 8), ("spans", 32)])
def test_derivatives(benchmark, method, radius, mode):
    benchmark.group = f"derivatives in the lens and the image, {method}, radius {radius}"
    scatter, image, lens = program(method, radius, discs.two_discs(512, radius))
    loss = lambda image, lens: jnp.sum(scatter(image, lens) ** 2)
    ones = (jnp.ones_like(image), ThinLens(1.0, 1.0, 1.0))
    function = {
        "forward": jax.jit(loss),
        "jvp": jax.jit(lambda *x: jax.jvp(loss, x, ones)),
        "grad": jax.jit(jax.grad(loss, argnums=(0, 1))),
    }[mode]
    lowered = function.lower(image, lens)
    start = time.perf_counter()
    compiled = lowered.compile()
    benchmark.extra_info["seconds to compile"] = round(time.perf_counter() - start, 1)
    memory = compiled.memory_analysis().temp_size_in_bytes / image.nbytes
    benchmark.extra_info["images of memory"] = round(memory, 1)
    run(benchmark, waited(function, image, lens))


@pytest.mark.parametrize("how", ["batch", "one by one"])
@pytest.mark.parametrize(("name", "radius"), [("tiles", 8), ("spans", 32)])
def test_batch(benchmark, name, radius, how):
    """Four images, of which one is blurred more than all others together."""
    benchmark.group = f"four pictures, {name}, radius {radius}"
    image, depth, lens = discs.two_discs(512, radius)
    images, depths = jnp.stack([jnp.asarray(image)] * 4), jnp.stack([jnp.asarray(depth)] * 4)
    lenses = [ThinLens(aperture, 2.0, lens.focal_pixels) for aperture in (1.0, 0.2, 0.1, 0.0)]
    scatter = lambda *x: dof.scatter(*x, max_coc=2.0 * radius, program=name, **OPTIONS)
    if how == "batch":
        together = jax.tree.map(lambda *x: jnp.stack(x), *lenses)
        run(benchmark, waited(jax.jit(jax.vmap(scatter)), images, depths, together))
    else:
        single = jax.jit(scatter)
        members = list(zip(images, depths, lenses, strict=True))
        run(benchmark, lambda: [jax.block_until_ready(single(*x)) for x in members])
