"""How the time of scatter grows with the radius and with the image, beside native code.

`python -m benchmarks.growth --out docs` measures and draws `growth.csv` and `growth.png`,
in about three minutes. Nothing else should run meanwhile.
"""

import argparse
import csv
import itertools
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
from matplotlib import pyplot as plt
from tqdm import tqdm

from benchmarks.native import scatter as native
from benchmarks.scenes import discs
from jaxfx import dof, tradeoff
from jaxfx.dof.scatter import cheapest


RADII = (1, 2, 4, 8, 12, 16, 24, 32, 48, 64)
SIDES = (128, 256, 512, 1024, 2048)
METHODS = ("native", "segment_sum", "shift", "tiles", "spans")
# A point that would take longer, at the pace of the one before it, is left out.
MOST_SECONDS = 4.0
# Taps that "segment_sum" may write out: some 40 bytes each.
MOST_TAPS = 2**25


def seconds(method, side, radius):
    image, depth, lens = discs.two_discs(side, radius)
    if method == "native":
        call = lambda: native.scatter(image, depth, lens, 2.0, 2.0)
    else:
        options = {"gamma": 2.0, "epsilon": 2.0, "max_coc": 2.0 * radius, "program": method}
        scatter = jax.jit(lambda *x: dof.scatter(*x, **options))
        arguments = jnp.asarray(image), jnp.asarray(depth), lens
        call = lambda: jax.block_until_ready(scatter(*arguments))
    call()
    times, begin = [], time.perf_counter()
    while len(times) < 3 or (len(times) < 9 and time.perf_counter() - begin < 1.0):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times), max(times) - min(times)


def sweep(method, points, bar):
    """Rows of side, radius, method, median and spread, while a point is not too slow."""
    last = None
    for side, radius in points:
        work = side**2 * (2 * radius + 1) ** (1 if method == "spans" else 2)
        too_many = method == "segment_sum" and side**2 * (2 * radius + 1) ** 2 > MOST_TAPS
        if not too_many and (last is None or last[1] * work / last[0] < MOST_SECONDS):
            median, spread = seconds(method, side, radius)
            last = work, median
            yield side, radius, method, median, spread
        bar.update()


def draw(rows, path):
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.2), sharey=True, layout="constrained")
    for method in METHODS:
        for ax, fixed, at, along in ((axes[0], 0, 512, 1), (axes[1], 1, 8, 0)):
            # Both sweeps pass through one point: the first of the two is drawn.
            line = [row for row in rows if row[2] == method and row[fixed] == at]
            line = sorted({row[along]: row for row in reversed(line)}.values())
            style = {"color": "0.3", "linestyle": "--"} if method == "native" else {}
            ax.errorbar(
                [row[along] for row in line],
                [1e3 * row[3] for row in line],
                yerr=[5e2 * row[4] for row in line],
                marker="o",
                markersize=3.5,
                label="native (numba)" if method == "native" else method,
                **style,
            )
    radii = [(r / 2, cheapest(512, 512, float(r))) for r in range(2, 129)]
    sides = [(n, cheapest(n, n, 16.0)) for n in range(128, 2049)]
    for ax, chosen in ((axes[0], radii), (axes[1], sides)):
        for (_, one), (at, other) in itertools.pairwise(chosen):
            if one != other:
                ax.axvline(at, color="0.7", zorder=0)
                low = {"transform": ax.get_xaxis_transform(), "ha": "center"}
                ax.text(at, 0.02, f"auto:\n{one} | {other}", color="0.4", fontsize=7, **low)
    axes[0].set(
        xlabel="largest radius (pixels), 512 x 512", ylabel="time (ms, median of 3 to 9)"
    )
    axes[1].set(xlabel="side of the picture (pixels), radius 8")
    for ax, ticks in zip(axes, (RADII, SIDES), strict=True):
        ax.set_xscale("log", base=2)
        ax.set_yscale("log")
        ax.set_xticks([t for t in ticks if t & (t - 1) == 0])
        ax.xaxis.set_major_formatter(mpl.ticker.ScalarFormatter())
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    tradeoff.save(figure, path)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for csv and picture")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    sweeps = ([(512, r) for r in RADII], [(s, 8) for s in SIDES])
    rows = []
    with tqdm(total=len(METHODS) * sum(map(len, sweeps)), unit="point") as bar:
        for points in sweeps:
            for method in METHODS:
                rows += sweep(method, points, bar)
    with open(out / "growth.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["side", "radius", "method", "seconds", "spread"])
        writer.writerows(rows)
    draw(rows, out / "growth.png")


if __name__ == "__main__":
    main()
