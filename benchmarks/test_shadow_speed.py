"""Masked percentage-closer filtering against full and native, in one run: 512 x 512, float32.

`pytest --benchmark-only benchmarks/test_shadow_speed.py` prints each group with the
ratios to its quickest. The scene: two discs over a floor that is seen turned, a pixel 0.9
texels wide; the discs are smaller for larger filters, so that 3 to 5 % of the pixels lie in a
penumbra. `share` says how many were filtered, `comparisons` how many were made, of all that
the full filter makes; the screen mask filters more, lest it miss.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.native import shadow as native_shadow
from benchmarks.scenes.shadow import FLOOR, two_discs
from jaxfx import shadow
from jaxfx.shadow.edge import usual_dilation


SIDE, BIAS = 512, 0.05


def run(benchmark, function):
    benchmark.pedantic(function, rounds=25, warmup_rounds=2)


def program(function, shadow_map, receivers, **options):
    """The compiled call, its arguments on the device."""
    data = jnp.asarray(shadow_map), shadow.Receivers(*map(jnp.asarray, receivers))
    compiled = jax.jit(lambda *x: function(*x, bias=BIAS, **options)).lower(*data).compile()
    return lambda: jax.block_until_ready(compiled(*data))


def masked(edges, size, shadow_map, receivers):
    """The options of `edge_pcf`: the screen mask reaches as far as it would outside `jit`."""
    if edges == "depth":
        return {"size": size, "edges": edges}
    data = jnp.asarray(shadow_map), shadow.Receivers(*map(jnp.asarray, receivers))
    reach = usual_dilation(*data, jnp.float32(BIAS), jnp.float32(0), size)
    return {"size": size, "edges": edges, "dilation": reach}


@pytest.mark.parametrize("size", [7, 21])
@pytest.mark.parametrize("method", ["native", "pcf", "screen", "depth"])
def test_filter(benchmark, method, size):
    benchmark.group = f"{size} x {size}, 3 to 5 % of the pixels in a penumbra"
    scene = two_discs(size)
    native = native_shadow.pcf(*scene, size, BIAS)
    if method == "native":
        run(benchmark, lambda: native_shadow.pcf(*scene, size, BIAS))
        return
    if method == "pcf":
        function = program(shadow.pcf, *scene, size=size)
    else:
        options = masked(method, size, *scene)
        function = program(shadow.edge_pcf, *scene, **options)
        found = program(shadow.candidates, *scene, **options)()
        share = float(found.where.mean())
        assert 0.03 < share < (0.05 if method == "depth" else 0.07)
        per_pixel = 2 if method == "depth" else 1
        assert int(found.comparisons) == per_pixel * SIDE**2 + int(found.where.sum()) * size**2
        benchmark.extra_info["share"] = share
        benchmark.extra_info["comparisons"] = int(found.comparisons) / (SIDE * size) ** 2
    run(benchmark, function)
    np.testing.assert_allclose(function(), native, atol=1e-6)


@pytest.mark.parametrize("method", ["pcf", "screen", "depth"])
def test_without_an_edge(benchmark, method):
    benchmark.group = "21 x 21, all lit"
    shadow_map, receivers = two_discs(21)
    scene = np.full_like(shadow_map, FLOOR), receivers
    if method == "pcf":
        run(benchmark, program(shadow.pcf, *scene, size=21))
    else:
        options = {"size": 21, "edges": method, "dilation": 14 if method == "screen" else None}
        run(benchmark, program(shadow.edge_pcf, *scene, **options))
