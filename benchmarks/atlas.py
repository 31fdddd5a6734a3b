"""Every method of every effect, measured and charted.

Measures the methods of depth of field, blur, reprojection, ray search, shadows, relighting and
a bounce of light, and the plans of `budget`, at several settings on two scenes each, the second
made to fail. Writes `atlas.csv`, a row for each measurement, `atlas.txt`, the machine, and for
each effect the charts of time and of memory against error, on each scene, and of time and error
against the size of the image and against the effect's own size, as PNG and SVG. Nothing else
should run meanwhile.
"""

import argparse
import csv
import functools
import importlib.metadata
import io
import itertools
import math
import os
import platform
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import matplotlib
from tqdm.auto import tqdm

from benchmarks import atlas_cases
from benchmarks.atlas_cases import (
    FENCE,
    HILLS,
    POSTS,
    SPIKES,
    STILL,
    Case,
    OnHost,
    Planned,
    Point,
)
from examples._begin import fail, make_folder
from jaxfx import tradeoff
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator


# An image this near to the reference is drawn as this near: it differs by rounding.
EXACT = 80.0


class Effect(NamedTuple):
    """How an effect is charted: its cases, its scenes and the values of its own size."""

    title: str
    case: Callable[[Point], Case]
    scenes: tuple[str, str]
    own: str
    usual: int
    owns: tuple[int, ...]
    usually: str
    truth: str


EFFECTS = {
    "dof": Effect(
        "depth of field",
        atlas_cases.depth_of_field,
        (STILL, FENCE),
        "largest circle of confusion (pixels)",
        16,
        (4, 8, 16, 32),
        "circles of confusion up to {} pixels",
        "128 passes through the lens, 16 if quick; all but multi-pass are given a picture",
    ),
    "blur": Effect(
        "blur",
        atlas_cases.blurred,
        (STILL, SPIKES),
        "passes of 9 taps that are as wide",
        4,
        (1, 2, 4, 8, 16),
        "as wide as {} passes of 9 taps",
        "the true Gaussian, in float64",
    ),
    "reproject": Effect(
        "reprojection",
        atlas_cases.warped,
        (STILL, FENCE),
        "turn of the camera (degrees)",
        3,
        (1, 3, 6, 12),
        "camera turned by {} degrees",
        "the mesh seen from there; holes count as right, so who draws less errs less",
    ),
    "intersect": Effect(
        "ray search",
        atlas_cases.searched,
        (HILLS, POSTS),
        "steps",
        32,
        (4, 8, 16, 32, 64, 128, 256),
        "at most {} steps where no number stands",
        "the pyramid's exact walk",
    ),
    "shadow": Effect(
        "shadow",
        atlas_cases.shadowed,
        (STILL, FENCE),
        "side of the filter (texels)",
        7,
        (3, 7, 11, 15, 21),
        "filter of {0} x {0} where no number stands",
        "36 rays to each point of a square lamp",
    ),
    "relight": Effect(
        "relighting",
        atlas_cases.relit,
        (STILL, FENCE),
        "lights",
        16,
        (1, 4, 16, 64),
        "{} lights",
        "every light shaded, unshadowed",
    ),
    "bounce": Effect(
        "a bounce of light",
        atlas_cases.bounced,
        (STILL, FENCE),
        "rank of the transfer",
        64,
        (4, 16, 64, 128),
        "by way of 256 points",
        "all 256 singular vectors",
    ),
}


class Row(NamedTuple):
    """A measurement: a line of `atlas.csv`. What is not known is NaN there, and empty."""

    effect: str
    method: str
    setting: str
    scene: str
    height: int
    width: int
    own: int
    milliseconds: float
    spread_milliseconds: float
    psnr: float
    rmse: float
    memory_bytes: float

    @property
    def at(self) -> tuple:
        return self.scene, self.height, self.own


def points(effect: Effect, arguments) -> list[tuple[Point, bool]]:
    """Where to measure, and whether every setting or the usual ones alone."""
    side, passes = arguments.size, 16 if arguments.quick else 128
    whole = [Point(name, side, effect.usual, passes) for name in effect.scenes]
    first = whole[0]
    sides = [first._replace(side=n) for n in (side // 2, 2 * side)]
    owns = [first._replace(own=n) for n in effect.owns if n != effect.usual]
    if arguments.quick:
        sides, owns = sides[:1], owns[:1]
    return [(at, True) for at in whole] + [(at, False) for at in (*sides, *owns)]


def measure(key: str, arguments, bar) -> list[Row]:
    """Every row of an effect."""
    effect, rows, programs = EFFECTS[key], [], {}
    for at, every in points(effect, arguments):
        bar.set_postfix_str(f"{effect.title}, {at.scene}, {at.side} x {at.side}, {at.own}")
        case = effect.case(at)
        for method, settings in case.methods.items():
            for setting in list(settings) if every else list(settings)[:1]:
                function = settings[setting]
                if isinstance(function, Planned) and not every:
                    continue
                if isinstance(function, OnHost):
                    call = lambda function=function: function.call()
                else:
                    name = (method, setting, at.side, at.own)
                    if isinstance(function, Planned):  # It serves this scene alone.
                        name, function = (*name, at.scene), function.plan(*case.data)
                    if name not in programs:
                        programs[name] = jax.jit(function).lower(*case.data).compile()
                    call = functools.partial(programs[name], *case.data)
                (found,) = tradeoff.measure(
                    {f"{method} {setting}": call},
                    case.truth,
                    mask=case.counted,
                    repeats=3 if arguments.quick else 11,
                    max_seconds=0.4,
                    memory=not isinstance(function, OnHost),
                    progress=False,
                )
                psnr = found.psnr if case.counted is None else found.band_psnr
                at_side = (at.scene, at.side, at.side, at.own)
                times = 1e3 * found.seconds, 1e3 * found.spread
                scores = psnr, 10 ** (-psnr / 20), found.memory
                rows.append(Row(key, method, setting, *at_side, *times, *scores))
        bar.update()
    return rows


def write_rows(rows: list[Row], path: Path) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    for row in rows:
        shown = (f"{v:.5g}" if isinstance(v, float) else v for v in row)
        writer.writerow("" if value == "nan" else value for value in shown)
    write_whole(path, text.getvalue().encode())


def read_rows(path: Path) -> list[Row]:
    """What `write_rows` wrote."""
    kinds = Row.__annotations__
    value = lambda field, text: kinds[field](
        "nan" if text == "" and kinds[field] is float else text
    )
    with open(path, newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return [Row._make(value(field, line[field]) for field in Row._fields) for line in lines]


def machine() -> str:
    """What the times depend on."""
    try:
        found = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
        name = found[1] if found else platform.machine()
    except OSError:
        name = platform.processor() or platform.machine()
    versions = [f"{one} {importlib.metadata.version(one)}" for one in ("jaxfx", "jax", "numpy")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return ", ".join([name, f"{cores} cores", f"Python {platform.python_version()}", *versions])


# --- Charts


def grouped(rows: list[Row]) -> dict[str, list[Row]]:
    """The rows of each method."""
    groups = {}
    for row in rows:
        groups.setdefault(row.method, []).append(row)
    return groups


def draw_errors(rows: list[Row], effect: Effect, cost: tradeoff.Cost, note: str):
    """All methods at one point: what they cost against their error."""
    name = lambda row: f"{row.method} {row.setting}".strip()
    measurements = [
        tradeoff.Measurement(
            name(row),
            row.milliseconds / 1e3,
            row.spread_milliseconds / 1e3,
            min(row.psnr, EXACT),
            math.nan,
            math.nan,
            row.memory_bytes,
        )
        for row in rows
    ]
    lines, unknown = {}, []
    for method, group in grouped(rows).items():
        known = sorted(
            (row for row in group if cost == "seconds" or not math.isnan(row.memory_bytes)),
            key=lambda row: row.milliseconds if cost == "seconds" else row.memory_bytes,
        )
        unknown += [] if known else [method]
        if len(known) > 1:
            lines[method] = [name(row) for row in known]
    if unknown:
        note = f"memory not known: {', '.join(unknown)}\n{note}"
    figure, ax = plt.subplots(figsize=(8, 5.6), layout="constrained")
    row = rows[0]
    fixed = effect.usually.format(row.own)
    ax.set_title(
        f"{effect.title}: {row.scene}, {row.height} x {row.width}; {fixed}", fontsize=10
    )
    write_margin(figure, note)
    tradeoff.plot(measurements, ax, lines=lines, cost=cost)
    figure.set_layout_engine("none")  # All has its place.
    return figure


def draw_growth(rows: list[Row], *, effect: Effect, along: str, label: str, note: str):
    """The usual setting of every method: time and error along a size."""
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.6), layout="constrained")
    value = lambda row: getattr(row, along)
    lines = [lot for lot in grouped(rows).values() if len(lot) > 1]
    for index, line in enumerate(lines):
        line.sort(key=value)
        dashes = "--" if index >= 10 else "-"
        style = {"color": f"C{index % 10}", "marker": "osD^v<>P"[index % 8], "markersize": 4}
        style |= {"linewidth": 1, "linestyle": dashes}
        x, times = [value(row) for row in line], [row.milliseconds for row in line]
        axes[0].plot(x, times, label=line[0].method, **style)
        axes[1].plot(x, [min(row.psnr, EXACT) for row in line], **style)
    ticks = sorted({value(row) for row in rows})
    for ax in axes:
        ax.set_xscale("log", base=2)
        ax.set_xticks(ticks, labels=ticks)
        ax.minorticks_off()
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
    axes[0].set_yscale("log")
    axes[0].yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes[0].yaxis.set_major_formatter("{x:g}")
    axes[0].yaxis.set_minor_formatter("{x:g}")
    axes[0].set_ylabel("time of a picture (ms, median)")
    axes[1].set_ylabel("PSNR to the reference (dB)")
    row = rows[0]
    size = f"{row.height} x {row.width}"
    fixed = size if along == "own" else effect.usually.format(row.own)
    figure.suptitle(f"{effect.title}: {row.scene}; {fixed}", fontsize=10)
    figure.legend(loc="outside right upper", fontsize="small")
    write_margin(figure, note)
    return figure


def write_margin(figure, note: str) -> None:
    style = {"fontsize": 7, "color": "0.35", "x": 0.01, "ha": "left"}
    figure.supxlabel(note, **style)


def charts(rows: list[Row], key: str, where: str) -> dict[str, Callable[[], Any]]:
    """What draws each figure of an effect, by name."""
    effect, rows = EFFECTS[key], [row for row in rows if row.effect == key]
    first, note = rows[0], f"reference: {effect.truth}\n{where}"
    if max(row.psnr for row in rows) > EXACT:
        note = f"{EXACT:g} dB stands for that and more; {note}"
    figures = {}
    for scene, cost in itertools.product(effect.scenes, get_args(tradeoff.Cost)):
        there = [row for row in rows if row.at == (scene, first.height, effect.usual)]
        name = f"{key}_{cost}_{scene}".replace("seconds", "time").replace(" ", "_")
        figures[name] = functools.partial(draw_errors, there, effect, cost, note)
    # The usual setting of a method comes first at each point.
    usual = {(row.method, row.at): row for row in reversed(rows) if row.scene == first.scene}
    usual = list(usual.values())[::-1]
    sizes = [row for row in usual if row.own == effect.usual]
    owns = [row for row in usual if row.height == first.height]
    growth = functools.partial(draw_growth, effect=effect, note=note)
    side = "side of the picture (pixels)"
    figures[f"{key}_size"] = functools.partial(growth, sizes, along="width", label=side)
    figures[f"{key}_own"] = functools.partial(growth, owns, along="own", label=effect.own)
    return figures


def save(figures: dict[str, Callable[[], Any]], folder: Path) -> None:
    for name, draw in figures.items():
        figure = draw()
        for kind in ("png", "svg"):
            tradeoff.save(figure, folder / f"{name}.{kind}")
        plt.close(figure)


# --- The command


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    add("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS), help="all by default")
    add("--size", type=int, default=256, help="side of the pictures, even, pixels")
    add(
        "--quick", action="store_true", help="fewer sizes, passes and calls: a look, no figures"
    )
    add(
        "--csv",
        type=Path,
        help="draw this file's rows, as an earlier run wrote it, and measure nothing",
    )
    arguments = parser.parse_args()
    if arguments.size < 32 or arguments.size % 4:
        parser.error(f"--size must be a multiple of 4 from 32, got {arguments.size}")
    return arguments


def earlier(path: Path) -> tuple[list[Row], str]:
    """The rows of an earlier run and where it was made."""
    try:
        return read_rows(path), path.with_suffix(".txt").read_text().strip()
    except (OSError, KeyError, TypeError, ValueError) as error:
        fail(f"--csv must be a file that this command wrote, with its .txt: {error!r}")


def main() -> None:
    started = time.perf_counter()
    arguments = parse()
    out = make_folder(arguments.out)
    keys, names = arguments.effects, []
    if arguments.csv:
        rows, where = earlier(arguments.csv)
        keys = [key for key in keys if key in {row.effect for row in rows}]
    else:
        rows, where = [], machine()
        write_whole(out / "atlas.txt", f"{where}\n".encode())
    total = sum(len(points(EFFECTS[key], arguments)) for key in keys)
    with tqdm(total=total, unit="point", disable=arguments.csv is not None) as bar:
        for key in keys:
            if not arguments.csv:
                rows += measure(key, arguments, bar)
                write_rows(rows, out / "atlas.csv")
            figures = charts(rows, key, where)
            save(figures, out)
            names += figures
    seconds = time.perf_counter() - started
    print(f"{len(rows)} measurements, {len(names)} charts in {out}, {seconds:.0f} s")


if __name__ == "__main__":
    main()
