"""The cost of a wrong iris: scatter and layered by disc and by hexagon, to many pinholes.

`python -m benchmarks.iris_shapes [--out FILE.png]` renders planes with lights of 50 times white
through a hexagonal lens, pass by pass, and prints the PSNR of each method to that, clipped to
what a screen shows. A disc is tried around the hexagon and at its area. `--blades 0
--vignetting 0.8 --profile -0.7` makes cat's eyes and soap bubbles of them.
"""

import argparse
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, ThinLens, dof, io, metrics
from jaxfx._sampling import pixel_centers


WHITE = 50.0
# Of the lights in the pinhole image, in pixels.
RADIUS = 1.5


class Lit:
    """A disc in focus before a wall at night with lights on it."""

    DISC, WALL = 2.0, 8.0

    def __init__(self, side):
        self.size = side
        self.camera = PinholeCamera.from_fov(0.7, height=side, width=side)
        places = np.random.default_rng(5).uniform(-0.34, 0.34, (40, 2))
        # None is hidden by the disc, which no method could guess.
        self.lights = jnp.asarray(places[np.hypot(*places.T) > 0.24][:16] * self.WALL)

    def view(self, eye):
        """Image and depth from a camera, whose rays meet planes across the axis."""
        shape = self.size, self.size
        pixels = pixel_centers(*shape, jnp.float32)
        wall, disc = (
            eye.unproject(pixels, jnp.full(shape, depth, pixels.dtype))[..., :2]
            for depth in (self.WALL, self.DISC)
        )
        image = self.checkered(wall / self.WALL, [0.06, 0.08, 0.16])
        for light in self.lights:
            away = jnp.sum((wall - light) ** 2, axis=-1)
            is_lit = away < (RADIUS * self.WALL / self.camera.intrinsics[0, 0]) ** 2
            image = jnp.where(is_lit[..., None], WHITE, image)
        is_disc = jnp.sum(disc**2, axis=-1) < (0.2 * self.DISC) ** 2
        front = self.checkered(disc / self.DISC, [0.9, 0.6, 0.3])
        depth = jnp.where(is_disc, self.DISC, self.WALL)
        return jnp.where(is_disc[..., None], front, image), depth

    @staticmethod
    def checkered(at, tint):
        is_light = jnp.prod(jnp.sin(60 * at), axis=-1) > 0
        return jnp.asarray(tint) * jnp.where(is_light, 1.0, 0.5)[..., None]


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--side", type=int, default=128, help="of the images, in pixels")
    parser.add_argument("--samples", type=int, default=6144, help="passes of the reference")
    parser.add_argument("--coc", type=float, default=24.0, help="of the wall, in pixels")
    parser.add_argument("--blades", type=int, default=6)
    parser.add_argument("--vignetting", type=float, default=0.0)
    parser.add_argument("--profile", type=float, default=0.0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()

    lit = Lit(given.side)
    unit = ThinLens.from_camera(lit.camera, aperture=1.0, focus_distance=lit.DISC)
    aperture = given.coc / float(unit.circle_of_confusion(lit.WALL))
    lens = ThinLens.from_camera(lit.camera, aperture=aperture, focus_distance=lit.DISC)
    rim = {"vignetting": given.vignetting, "profile": given.profile}
    iris = dof.Iris(given.blades, rotation=0.3, **rim)
    view = jax.jit(lit.view)
    draw = lambda eye: view(eye)[0]
    options = {"samples": given.samples, "iris": iris}
    truth, convergence = dof.accumulate(draw, lit.camera, lens, **options)
    _, depth = view(lit.camera)
    # Edges are as smooth as those of the reference.
    pinhole = ThinLens.from_camera(lit.camera, aperture=0.0, focus_distance=lit.DISC)
    image = dof.accumulate(draw, lit.camera, pinhole, samples=16).image
    share = math.sqrt(float(iris.area()) / math.pi)
    equal = ThinLens(lens.aperture * share, lens.focus_distance, lens.focal_pixels)
    room = math.ceil(float(lens.circle_of_confusion(depth).max())) + 0.01
    shown, panels = lambda x: jnp.clip(x, 0, 1), [image, truth]
    print(f"convergence {float(convergence):.4f}, pinhole", end=" ")
    print(f"{float(metrics.psnr(shown(image), shown(truth))):.2f} dB")
    for name, method in (("scatter", dof.scatter), ("layered", dof.layered)):
        for shape, by, chosen in (
            ("iris", lens, iris),
            ("disc around it", lens, None),
            ("disc of equal area", equal, None),
        ):
            result = method(image, depth, by, max_coc=room, iris=chosen)
            decibels = float(metrics.psnr(shown(result), shown(truth)))
            print(f"{name:8} {shape:20} {decibels:6.2f} dB", flush=True)
            if method is dof.layered:
                panels.append(result)
    if given.out:
        io.write_png(given.out, jnp.concatenate([shown(x) for x in panels], axis=1))


if __name__ == "__main__":
    main()
