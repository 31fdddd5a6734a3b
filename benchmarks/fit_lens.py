"""Errors, stated errors and seconds of `fit.dof`, for `docs/fits.md`.

`python -m benchmarks.fit_lens ["still life"] [MESH ...]` fits multi-pass images of 320 x 240
pixels of the still life or of the meshes that are given, at three foci and two apertures, from
starts that are 30 % (aperture) and 15 % (focus) off, in both directions. A row of the table
holds the medians of a method, the worst in brackets; `--each` prints every fit. With `--save
FILE` fits are written as they come, and those in the file are not made again. `--seconds` makes
every fit twice and times the second, which compiles nothing. `--bounded` gives each fit a
`max_coc` of 1.5 times the largest circle of the scene: an empty background may have circles of
hundreds of pixels, which show nothing and take most of the time.
"""

import argparse
import itertools
import json
import pathlib
import time

import jax
import numpy as np

from benchmarks.layered_quality import FOCI, LARGEST, Case
from jaxfx import ThinLens, fit, scene


SIZE = (240, 320)
STARTS = {"large": (1.3, 1.15), "small": (0.7, 0.85)}
FREE = ("aperture", "focus_distance")
METHODS = {
    "scatter": {"parameters": FREE, "gamma": 0.0},
    "layered": {"effect": "layered", "parameters": FREE},
    "layered, guessed layer": {"effect": "layered", "parameters": FREE, "behind": "peel"},
    "layered, second layer": {"effect": "layered", "parameters": FREE},
    "scatter, squares": {"parameters": FREE, "gamma": 0.0, "loss": "squares"},
}
KEYS = ("scene", "focus", "largest", "method", "start")
STILL_LIFE = "still life"


def fitted(case, reference, lens, method, start, again, bound):
    """One fit as a record: the truth, and errors and stated errors as ratios to it.

    `bound` is the `max_coc` of the fit, pixels, or None.
    """
    options = METHODS[method] | {"max_coc": bound}
    if method.endswith("second layer"):
        options = options | {"behind": case.behind}
    aperture, focus = STARTS[start]
    begins = ThinLens(lens.aperture * aperture, lens.focus_distance * focus, lens.focal_pixels)
    data = reference, case.image, case.depth, begins
    if again:
        jax.block_until_ready(fit.dof(*data, throw=False, **options))
    begin = time.perf_counter()
    found = jax.block_until_ready(fit.dof(*data, throw=False, **options))
    took = time.perf_counter() - begin
    truth = {name: float(getattr(lens, name)) for name in FREE}
    return {
        "truth": [truth[name] for name in FREE],
        "error": [float(getattr(found.lens, name)) / truth[name] - 1 for name in FREE],
        "stated": [float(found.standard_errors[name]) / truth[name] for name in FREE],
        "footprint": float(found.footprint),
        "explained": float(found.explained),
        "doubt": found.doubt,
        "seconds": took,
    }


def fits(given, known):
    """The records of all fits that are asked for, those that are known first."""
    wanted = list(itertools.product(given.methods, given.starts))
    for path in given.meshes:
        title, case = STILL_LIFE if path == STILL_LIFE else pathlib.Path(path).stem, None
        for focus, largest in itertools.product(given.foci, given.largest):
            place = title, focus, largest
            yield from (known[place + how] for how in wanted if place + how in known)
            missing = [how for how in wanted if place + how not in known]
            if not missing:
                continue
            if case is None:
                mesh = scene.still_life() if path == STILL_LIFE else scene.load(path)
                case = Case(mesh, SIZE, given.samples)
            lens, reference = case.focused(FOCI[focus], largest)
            for method, start in missing:
                bound = 1.5 * largest if given.bounded else None
                row = fitted(case, reference, lens, method, start, given.seconds, bound)
                row = dict(zip(KEYS, (*place, method, start), strict=True)) | row
                if given.each:
                    print(row, flush=True)
                if given.save:
                    with given.save.open("a") as file:
                        print(json.dumps(row), file=file)
                yield row


def table(rows, methods, has_seconds):
    """The lines of a table in Markdown, one row for each method."""
    yield (
        "| method | error of aperture, % | error of focus, % | stated, % | within 1.96 | fits |"
        " success |" + has_seconds * " s |"
    )
    yield "|---|---:|---:|---:|---:|---:|---:|" + has_seconds * "---:|"
    for method in methods:
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        column = lambda name, own=own: np.array([row[name] for row in own])
        size, stated = 100 * np.abs(column("error")), 100 * column("stated")
        shown = [f"{np.median(size[:, i]):.1f} ({size[:, i].max():.1f})" for i in range(2)]
        held = 100 * (size < 1.96 * stated).mean(axis=0)
        line = (
            f"| {method} | {shown[0]} | {shown[1]} | {np.median(stated[:, 0]):.1f}, "
            f"{np.median(stated[:, 1]):.1f} | {held[0]:.0f} %, {held[1]:.0f} % | {len(own)} | "
            f"{np.sum(column('doubt') == '')} |"
        )
        took = column("seconds")
        yield line + has_seconds * f" {np.median(took):.1f} ({took.max():.1f}) |"


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "meshes",
        nargs="*",
        default=[STILL_LIFE],
        metavar="MESH",
        help="files that trimesh reads, or 'still life'",
    )
    parser.add_argument("--samples", type=int, default=256, help="passes of a reference")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=[*METHODS])
    parser.add_argument("--foci", nargs="*", choices=FOCI, default=[*FOCI])
    parser.add_argument("--largest", nargs="*", type=int, default=[*LARGEST], help="pixels")
    parser.add_argument("--starts", nargs="*", choices=STARTS, default=[*STARTS])
    parser.add_argument("--each", action="store_true", help="print every fit")
    parser.add_argument(
        "--save", type=pathlib.Path, metavar="FILE", help="of fits, as they come"
    )
    parser.add_argument("--seconds", action="store_true", help="make every fit twice")
    parser.add_argument(
        "--bounded", action="store_true", help="draw no larger circles than the scene needs"
    )
    given = parser.parse_args()
    known = {}
    if given.save and given.save.exists():
        rows = map(json.loads, given.save.read_text().splitlines())
        known = {tuple(row[key] for key in KEYS): row for row in rows}
    rows = list(fits(given, known))
    print(*table(rows, given.methods, given.seconds), sep="\n")


if __name__ == "__main__":
    main()
