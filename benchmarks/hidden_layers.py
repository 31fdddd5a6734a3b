"""The gain of a guessed hidden layer to `layered`, in decibels.

`python -m benchmarks.hidden_layers [MESH ...]` prints a row for each of three foci and two
apertures of every scene: the PSNR of one layer to the multi-pass reference, and how much more
two have, of which the second is guessed by `dof.peel` or true, and three, of which the second
is true and what lies behind both is guessed. The scenes are the still life,
the meshes that are given, and two rooms of boxes, on which nothing was chosen: one with eight
boxes, one behind a fence.
"""

import argparse
import functools as ft
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.layered_quality import FOCI, LARGEST, Case
from jaxfx import ThinLens, dof, metrics, scene
from tests.cases import rooms


# Of the camera in the rooms, about the vertical, in radians.
TURN = 0.3


class RoomCase:
    """A room as `Case` is a mesh; it has no second layer."""

    behind = None

    def __init__(self, place, size, samples):
        self.place, self.size, self.samples = place, size, samples
        pose = rooms.pose(TURN, 0.05, np.zeros(3))
        image, depth, self.camera = rooms.seen(place, pose, size, samples=4)
        self.image, self.depth = jnp.asarray(image), jnp.asarray(depth)

    def draw(self, eye):
        pose, intrinsics = (
            np.asarray(x, float) for x in (eye.world_from_camera, eye.intrinsics)
        )
        color, _ = rooms.cast(
            self.place, pose, np.linalg.inv(intrinsics), self.size, (0.5, 0.5)
        )
        return color.astype(np.float32)

    def focused(self, share, largest):
        """A lens with this share of what is seen before its focus, and its image."""
        focus = float(jnp.quantile(self.depth, share))
        lens = ft.partial(ThinLens.from_camera, self.camera, focus_distance=focus)
        widest = float(lens(aperture=1.0).circle_of_confusion(self.depth).max())
        lens = lens(aperture=largest / widest)
        truth = dof.accumulate(
            self.draw, self.camera, lens, samples=self.samples, progress=False
        )
        return lens, truth.image


def fenced(seed):
    """A room with three boxes, behind eight bars and a trunk."""
    place = rooms.room(seed, boxes=12)
    right, ahead = (
        np.array([np.cos(TURN), 0, -np.sin(TURN)]),
        np.array([np.sin(TURN), 0, np.cos(TURN)]),
    )
    for box, across in enumerate(np.linspace(-1.1, 1.1, 9), start=4):
        half = np.array([0.12 if box == 6 else 0.015, 1.5, 0.015])
        middle = across * right + 1.1 * ahead
        place.low[box], place.high[box] = middle - half, middle + half
    return place


def rows(case):
    """A focus, a largest circle; one layer, a guessed second, a true one, that and a guess."""
    for (name, share), largest in itertools.product(FOCI.items(), LARGEST):
        lens, truth = case.focused(share, largest)
        data, room = (case.image, case.depth, lens), largest + 0.01
        score = lambda truth=truth, data=data, room=room, **options: float(
            metrics.psnr(dof.layered(*data, max_coc=room, **options), truth)
        )
        true = three = np.nan
        if case.behind is not None:
            true, three = score(behind=[case.behind, None]), score(behind=case.behind)
        yield name, largest, np.array([score(behind=None), score(behind="peel"), true, three])


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="files that trimesh reads")
    parser.add_argument("--side", type=int, default=192, help="of the pictures, in pixels")
    parser.add_argument("--samples", type=int, default=256, help="passes of a reference")
    given = parser.parse_args()
    size = given.side, given.side
    cases: dict[str, Any] = {
        "still life": lambda: Case(scene.still_life(), size, given.samples)
    }
    for path in given.meshes:
        title = path.rpartition("/")[2]
        cases[title] = lambda path=path: Case(scene.load(path), size, given.samples)
    cases["room"] = lambda: RoomCase(rooms.room(11, boxes=8), size, given.samples)
    cases["fence"] = lambda: RoomCase(fenced(12), size, given.samples)
    print("| scene | focus | CoC | one layer | guessed second | true second | and a guess |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for title, case in cases.items():
        gains = []
        for name, largest, figures in rows(case()):
            gains.append(figures[1:] - figures[0])
            cells = "".join(f" {gain:+.2f} |" for gain in gains[-1]).replace("+nan", "")
            print(f"| {title} | {name} | {largest} | {figures[0]:.2f} |{cells}", flush=True)
        pairs = zip(np.mean(gains, axis=0), np.min(gains, axis=0), strict=True)
        cells = "".join(f" {mean:+.2f}, {least:+.2f} |" for mean, least in pairs)
        print(f"| {title} | mean, least | | |{cells}".replace("+nan, +nan", ""), flush=True)


if __name__ == "__main__":
    main()
