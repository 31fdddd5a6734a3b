"""Errors, stated errors and seconds of `fit.dof`, for `docs/fits.md`.

`python -m benchmarks.fit_lens [MESH ...]` fits multi-pass images of 320 x 240 pixels of the
still life and of every mesh that is given, at three foci and two apertures, from starts that
are 30 % (aperture) and 15 % (focus) off, in both directions. A row holds the medians of a
method, the worst in brackets; `--each` prints every fit.
"""

import argparse
import itertools
import time

import jax
import numpy as np

from benchmarks.layered_quality import FOCI, LARGEST, Case
from jaxfx import ThinLens, fit, scene


SIZE = (240, 320)
STARTS = (1.3, 1.15), (0.7, 0.85)
FREE = ("aperture", "focus_distance")
METHODS = {
    "scatter": {"parameters": FREE, "gamma": 0.0},
    "layered": {"effect": "layered", "parameters": FREE},
    "layered, second layer": {"effect": "layered", "parameters": FREE},
    "scatter, squares": {"parameters": FREE, "gamma": 0.0, "loss": "squares"},
}


def fits(case, name, options):
    """For every focus, aperture and start: name, errors, stated errors (ratios), seconds."""
    if name.endswith("second layer"):
        options = options | {"behind": case.behind}
    for (place, share), largest in itertools.product(FOCI.items(), LARGEST):
        lens, reference = case.focused(share, largest)
        for aperture, focus in STARTS:
            start = ThinLens(
                lens.aperture * aperture, lens.focus_distance * focus, lens.focal_pixels
            )
            begin = time.perf_counter()
            data = reference, case.image, case.depth, start
            fitted = jax.block_until_ready(fit.dof(*data, throw=False, **options))
            took = time.perf_counter() - begin
            truth = np.array([float(getattr(lens, name)) for name in FREE])
            error = np.array([float(getattr(fitted.lens, name)) for name in FREE]) / truth - 1
            stated = np.array([float(fitted.standard_errors[name]) for name in FREE]) / truth
            yield f"{place}, {largest} pixels", error, stated, took, fitted.success


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="files that trimesh reads")
    parser.add_argument("--samples", type=int, default=256, help="passes of a reference")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=[*METHODS])
    parser.add_argument("--each", action="store_true", help="print every fit")
    given = parser.parse_args()
    paths = [None, *given.meshes]
    meshes = [scene.still_life() if path is None else scene.load(path) for path in paths]
    cases = [Case(mesh, SIZE, given.samples) for mesh in meshes]
    print(
        "| method | error of aperture, % | error of focus, % | stated, % | within 1.96 | s "
        "| success |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in given.methods:
        rows = []
        for path, case in zip(paths, cases, strict=True):
            for place, *row in fits(case, name, METHODS[name]):
                rows.append(row)
                if given.each:
                    error, stated, took, success = row
                    print(
                        name,
                        path or "still life",
                        place,
                        100 * error,
                        100 * stated,
                        took,
                        success,
                        flush=True,
                    )
        error, stated, took, success = (np.array(column) for column in zip(*rows, strict=True))
        size = 100 * np.abs(error)
        shown = [f"{np.median(size[:, i]):.1f} ({size[:, i].max():.1f})" for i in range(2)]
        errors = ", ".join(f"{100 * np.median(stated[:, i]):.1f}" for i in range(2))
        held = (np.abs(error) < 1.96 * stated).mean(axis=0)
        print(
            f"| {name} | {shown[0]} | {shown[1]} | {errors} | "
            f"{100 * held[0]:.0f} %, {100 * held[1]:.0f} % | "
            f"{np.median(took):.1f} ({np.max(took):.1f}) | {success.sum()} of {len(rows)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
