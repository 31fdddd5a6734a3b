"""How often the 95 % intervals of `fit.dof` hold the true lens, for `docs/fits.md`.

`python -m benchmarks.fit_coverage` fits rooms of textured boxes, 64 x 48 pixels, seen through a
lens by 64 passes, from starts 30 % (aperture) and 15 % (focus distance) off, up or down by
chance. What is fitted is one pass by an effect, from one image: the model errs, and the errors
stated have to allow for it. Rooms that are doubted don't count, nor those where the start
blurs everything by more than 16 pixels: those lie all but at one depth. `--first` and `--count`
choose the rooms; on those of 100 to 149 and 200 to 246 the constants of
`jaxfx/fit/_circle_error.py` were chosen.
"""

import argparse

import numpy as np

from jaxfx import fit
from tests.cases import rooms


FREE = ("aperture", "focus_distance")
# Pixels, above the circles of all lenses that are tried; one number shares all programs.
LARGEST = 16.0


def fitted(seed, **options):
    """The errors of aperture and focus distance, those stated (ratios), and the doubt."""
    reference, image, depth, lens, start = rooms.through_a_lens(seed)
    if start.circle_of_confusion(depth).min() > LARGEST:
        return np.full(2, np.nan), np.full(2, np.nan), "The start blurs everything."
    options = {"max_coc": LARGEST, "throw": False} | options
    found = fit.dof(reference, image, depth, start, **options)
    truth = np.array([float(getattr(lens, name)) for name in FREE])
    error = np.array([float(getattr(found.lens, name)) for name in FREE]) / truth - 1
    stated = np.array([float(found.standard_errors[name]) for name in FREE]) / truth
    return error, stated, found.doubt


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--first", type=int, default=300, help="the first room")
    parser.add_argument("--count", type=int, default=120, help="of rooms")
    parser.add_argument("--effect", choices=["scatter", "layered"], default="scatter")
    parser.add_argument("--each", action="store_true", help="print every fit")
    given = parser.parse_args()
    errors, stated = [], []
    for seed in range(given.first, given.first + given.count):
        error, own, doubt = fitted(seed, effect=given.effect)
        if given.each:
            print(seed, 100 * error, 100 * own, doubt, flush=True)
        if not doubt:
            errors.append(np.abs(error))
            stated.append(own)
    error, stated = np.array(errors), np.array(stated)
    shown = lambda values: " and ".join(f"{100 * value:.1f}" for value in values)
    print(
        f"{given.effect}: {len(error)} of {given.count} rooms are no failure. Off by "
        f"{shown(np.median(error, axis=0))} % in the median (aperture and focus distance), "
        f"{shown(error.max(axis=0))} % at worst; stated {shown(np.median(stated, axis=0))} %; "
        f"within 1.96 stated errors {shown(np.mean(error < 1.96 * stated, axis=0))} %."
    )


if __name__ == "__main__":
    main()
