"""PSNR of `layered` with mixed pixels kept and split, in decibels.

`python -m benchmarks.mixed_pixels [MESH ...] [--out FOLDER]` prints a row for each of three
foci and two apertures of every scene: the PSNR of `layered` to the multi-pass reference, and
how much more it has with `mixed="split"`; then the same with two guessed layers. First from an
antialiased image, then from one whose pixels have the colour of their middle. The scenes are
wires of 1, 2 and 3 pixels that cross before a disc and a wall, the rooms of
`benchmarks.hidden_layers`, the still life and the meshes that are given. Everything was chosen
on the wires, of which pictures are written to the folder.
"""

import argparse
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.hidden_layers import RoomCase, fenced
from benchmarks.layered_quality import FOCI, LARGEST, Case
from jaxfx import PinholeCamera, ThinLens, dof, io, metrics, scene
from jaxfx._sampling import pixel_centers
from tests.cases import rooms


# Of the wires, in pixels.
WIDTHS = 1, 2, 3
# Rays to a side of a pixel, of antialiased images of the wires.
RAYS = 8


class Wires:
    """Six light wires before six dark ones before a disc before a wall, all across the axis."""

    LIGHT, DARK, DISC, WALL = 1.5, 2.0, 2.6, 4.0

    def __init__(self, side, samples):
        self.side, self.samples = side, samples
        self.camera = PinholeCamera.from_fov(0.8, height=side, width=side)
        rng = np.random.default_rng(3)
        directions = rng.normal(size=(3, 10, 2))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        self.waves = np.exp(rng.uniform(np.log(4), np.log(60), (3, 10, 1))) * directions
        self.phases = rng.uniform(0, 2 * np.pi, (3, 10))
        self.view = jax.jit(self._view)
        self.rough, self.depth = self.view(self.camera)
        inside = (np.arange(RAYS) + 0.5) / RAYS - 0.5
        rays = [self.view(self._moved(x, y))[0] for x in inside for y in inside]
        self.image = jnp.mean(jnp.stack(rays), axis=0)

    def _moved(self, right, down):
        """The camera whose pixels' middles lie elsewhere in them, by parts of a pixel."""
        move = jnp.asarray([right, down], jnp.float32)
        intrinsics = self.camera.intrinsics.at[:2, 2].add(move)
        return PinholeCamera(intrinsics, self.camera.world_from_camera)

    def _view(self, eye):
        shape = self.side, self.side
        pixels = pixel_centers(*shape, jnp.float32)

        def on(depth):
            """Where rays meet a plane, in tangents as the camera at the lens' middle has it."""
            return eye.unproject(pixels, jnp.full(shape, depth, pixels.dtype))[..., :2] / depth

        image, depth = self.waved(on(self.WALL), 0.07), jnp.full(shape, self.WALL)
        tangents = on(self.DISC)
        is_disc = jnp.sum((tangents - jnp.asarray([0.2, 0.15])) ** 2, axis=-1) < 0.13**2
        disc = self.waved(tangents + 1, 0.05) * jnp.asarray([1.0, 0.6, 0.3])
        image = jnp.where(is_disc[..., None], disc, image)
        depth = jnp.where(is_disc, self.DISC, depth)
        for plane, angle, tint in (
            (self.DARK, 0.13, [0.05, 0.05, 0.08]),
            (self.LIGHT, 1.35, [0.95, 0.85, 0.3]),
        ):
            across = on(plane) @ jnp.asarray([-np.sin(angle), np.cos(angle)], jnp.float32)
            for index, width in enumerate(2 * WIDTHS):
                half = width / 2 / self.camera.intrinsics[0, 0]
                is_wire = jnp.abs(across - 0.12 * index + 0.3) < half
                image = jnp.where(is_wire[..., None], jnp.asarray(tint), image)
                depth = jnp.where(is_wire, plane, depth)
        return image, depth

    def waved(self, at, amplitude):
        waves = jnp.einsum("cwk,yxk->yxcw", self.waves, at) + self.phases
        return 0.5 + amplitude * jnp.sin(waves).sum(axis=-1)

    def focused(self, share, largest):
        """A lens in focus at the light wires, the disc or the wall, and its image."""
        focus = {0.1: self.LIGHT, 0.5: self.DISC, 0.9: self.WALL}[share]
        lens = lambda aperture: ThinLens.from_camera(
            self.camera, aperture=aperture, focus_distance=focus
        )
        lens = lens(largest / float(lens(1.0).circle_of_confusion(self.depth).max()))
        draw = lambda eye: self.view(eye)[0]
        return lens, dof.accumulate(draw, self.camera, lens, samples=self.samples).image


def rough(case):
    """The image of pixels' middles."""
    if isinstance(case, Wires):
        return case.rough
    if isinstance(case, Case):
        return case.layer(case.camera)[0]
    pose, intrinsics = (
        np.asarray(x, float) for x in (case.camera.world_from_camera, case.camera.intrinsics)
    )
    color, _ = rooms.cast(case.place, pose, np.linalg.inv(intrinsics), case.size, (0.5, 0.5))
    return jnp.asarray(color.astype(np.float32))


GUESSES = "peel", ("peel", "peel")


def rows(case, out=None):
    """A focus, a largest circle; for each image and number of guesses, kept and split."""
    for (name, share), largest in itertools.product(FOCI.items(), LARGEST):
        lens, truth = case.focused(share, largest)
        figures, panels = [], [truth]
        for image, behind in itertools.product((case.image, rough(case)), GUESSES):
            for mixed in ("keep", "split"):
                options = {"behind": behind, "mixed": mixed, "max_coc": largest + 0.01}
                panels.append(dof.layered(image, case.depth, lens, **options))
                figures.append(float(metrics.psnr(panels[-1], truth)))
        if out is not None:
            shown = [panels[0], panels[1], panels[2], panels[4]]
            io.write_png(out / f"wires_{name}_{largest}.png", jnp.concatenate(shown, axis=1))
        yield name, largest, np.array(figures).reshape(-1, 2)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="files that trimesh reads")
    parser.add_argument("--side", type=int, default=192, help="of the pictures, in pixels")
    parser.add_argument("--samples", type=int, default=256, help="passes of a reference")
    parser.add_argument("--out", type=Path, help="a folder for pictures of the wires")
    given = parser.parse_args()
    size = given.side, given.side
    cases: dict[str, Any] = {
        "wires": lambda: Wires(given.side, given.samples),
        "room": lambda: RoomCase(rooms.room(11, boxes=8), size, given.samples),
        "fence": lambda: RoomCase(fenced(12), size, given.samples),
        "still life": lambda: Case(scene.still_life(), size, given.samples),
    }
    for path in given.meshes:
        title = path.rpartition("/")[2]
        cases[title] = lambda path=path: Case(scene.load(path), size, given.samples)
    print("| scene | focus | CoC | antialiased | two guesses | of middles | two guesses |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for title, case in cases.items():
        for name, largest, figures in rows(case(), given.out if title == "wires" else None):
            cells = "".join(f" {kept:.2f} {split - kept:+.2f} |" for kept, split in figures)
            print(f"| {title} | {name} | {largest} |{cells}", flush=True)


if __name__ == "__main__":
    main()
