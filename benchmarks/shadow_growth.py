"""How the time of shadow filters grows with their size: 512 x 512 receivers, float32.

`python -m benchmarks.shadow_growth` measures the scene of `test_shadow_speed.py` and
writes `shadow_growth.csv` beside itself, in about a minute. Nothing else should run meanwhile.
`notebooks/shadow.py` draws it.
"""

import csv
import functools as ft
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.native import shadow as native_shadow
from benchmarks.scenes.shadow import two_discs
from jaxfx import OrthographicCamera, shadow
from jaxfx.shadow.edge import usual_dilation


SIZES, BIAS, ROUNDS = (3, 5, 7, 11, 15, 21, 31), 0.05, 15
CAMERA = OrthographicCamera(100.0, [256, 256], np.eye(4))


def methods(size, scene):
    """Calls by name."""
    data = jnp.asarray(scene[0]), shadow.Receivers(*map(jnp.asarray, scene[1]))
    zero = jnp.zeros((), jnp.float32)
    dilation = usual_dilation(*data, zero + BIAS, zero, size)
    masked = ft.partial(shadow.edge_pcf, size=size)
    functions = {
        "pcf": ft.partial(shadow.pcf, size=size),
        "screen mask": ft.partial(masked, edges="screen", dilation=dilation),
        "depth mask": ft.partial(masked, edges="depth"),
        "variance": ft.partial(shadow.variance, size=size),
        "prefiltered": ft.partial(shadow.prefiltered, size=size),
        "pcss": lambda *data, bias: shadow.pcss(
            *data, CAMERA, size=size, light_size=0.01 * size, bias=bias
        ),
    }
    calls = {"native pcf": lambda: native_shadow.pcf(*scene, size, BIAS)}
    for name, function in functions.items():
        compiled = jax.jit(ft.partial(function, bias=BIAS)).lower(*data).compile()
        calls[name] = lambda compiled=compiled: jax.block_until_ready(compiled(*data))
    return calls


def main():
    rows = []
    for size in SIZES:
        calls = methods(size, two_discs(size))
        times = {name: [] for name in calls}
        # In turn, that a disturbance meets all; but native code alone, whose threads spin on.
        native, others = list(calls)[:1] * ROUNDS, list(calls)[1:] * ROUNDS
        for name in (*others, *native):
            begin = time.perf_counter()
            calls[name]()
            times[name].append(1e3 * (time.perf_counter() - begin))
        for name, each in times.items():
            quarters = statistics.quantiles(each[2:], n=4)
            rows.append([size, name, *(f"{q:.3f}" for q in (quarters[1], *quarters[::2]))])
    with open(Path(__file__).parents[1] / "docs/shadow_growth.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["size", "method", "milliseconds", "lower_quartile", "upper_quartile"])
        writer.writerows(rows)


if __name__ == "__main__":
    main()
