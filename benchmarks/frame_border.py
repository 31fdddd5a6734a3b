"""PSNR of `layered` near the frame, by what is assumed to lie beyond it.

`python -m benchmarks.frame_border [MESH ...]` prints a row for each of three foci and two
apertures of every scene of `hidden_layers`: the PSNR to the multi-pass reference with the last
pixels repeated, in the border as wide as the largest radius and inside of it; and how much more
there is in the border with the image mirrored, and with as wide a margin of a larger image. One
layer is used, and a guessed one behind it.
"""

import argparse
import functools as ft
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.hidden_layers import RoomCase, fenced
from benchmarks.layered_quality import FOCI, LARGEST, Case
from jaxfx import dof, metrics, scene
from tests.cases import rooms


# Pixels by which the scenes are rendered larger on each side: the largest radius.
MARGIN = max(LARGEST) // 2


def rows(case):
    """A focus, a largest circle, and the figures of the border and, last, of the inside."""
    cut = lambda x: x[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for (name, share), largest in itertools.product(FOCI.items(), LARGEST):
        lens, truth = case.focused(share, largest)
        truth, width = cut(truth), largest // 2
        border = np.ones(truth.shape[:2], bool)
        border[width:-width, width:-width] = False

        def score(picture, mask, truth=truth):
            return float(metrics.psnr(picture, truth, mask=jnp.asarray(mask)))

        blur = ft.partial(dof.layered, lens=lens, max_coc=largest + 0.01)
        image, depth = cut(case.image), cut(case.depth)
        edge = blur(image, depth)
        mirrored = blur(image, depth, pad="reflect")
        wide = blur(case.image, case.depth, margin=MARGIN)
        found = [score(picture, border) for picture in (edge, mirrored, wide)]
        yield name, largest, np.array([*found, score(edge, ~border)])


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="files that trimesh reads")
    parser.add_argument("--side", type=int, default=128, help="of the pictures, in pixels")
    parser.add_argument("--samples", type=int, default=64, help="passes of a reference")
    given = parser.parse_args()
    size, samples = (given.side + 2 * MARGIN,) * 2, given.samples
    cases: dict[str, Any] = {"still life": lambda: Case(scene.still_life(), size, samples)}
    for path in given.meshes:
        title = path.rpartition("/")[2]
        cases[title] = lambda path=path: Case(scene.load(path), size, samples)
    cases["room"] = lambda: RoomCase(rooms.room(11, boxes=8), size, samples)
    cases["fence"] = lambda: RoomCase(fenced(12), size, samples)
    print("| scene | focus | CoC | inside | border, repeated | mirrored | with a margin |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for title, make in cases.items():
        for name, largest, (edge, mirrored, wide, inside) in rows(make()):
            print(
                f"| {title} | {name} | {largest} | {inside:.2f} | {edge:.2f} | "
                f"{mirrored - edge:+.2f} | {wide - edge:+.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
