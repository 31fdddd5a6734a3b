"""Layered scatter beside the best scatter, in decibels to the multi-pass reference.

`python -m benchmarks.layered_quality [MESH ...]` prints a row for each of three foci and
two apertures of every scene, the still life if none is given: the PSNR of scatter with its best
gamma and epsilon, of the whole image and of the band of half the largest circle of confusion
about the edges in depth, and how much more one layer and two layers have.
"""

import argparse
import functools as ft
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import ThinLens, dof, metrics, relight, scene


FOCI = {"near": 0.1, "middle": 0.5, "far": 0.9}
LARGEST = 12, 32
GAMMAS, EPSILONS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0), (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)


class Case:
    """Views of a scene: a pinhole image, what is behind it, and references through lenses."""

    def __init__(self, mesh, size, samples):
        self.mesh, self.samples = mesh, samples
        self.size = {"height": size[0], "width": size[1]}
        self.camera = scene.default_camera(mesh, **self.size)
        self.lights = scene.default_lights(self.camera)
        self.shade = jax.jit(relight.render)
        _, self.depth = self.layer(self.camera)
        self.behind = self.layer(self.camera, 1)
        # Edges are as smooth as those of the references.
        self.image = self.through(self.lens(0.0, 1.0), 16)

    def layer(self, eye, layer=0):
        seen = scene.gbuffer(self.mesh, eye, **self.size, layer_index=layer)
        return self.shade(seen, eye, self.lights), seen.depth

    def lens(self, aperture, focus):
        return ThinLens.from_camera(self.camera, aperture=aperture, focus_distance=focus)

    def through(self, lens, samples):
        draw = lambda eye: self.layer(eye)[0]
        return dof.accumulate(draw, self.camera, lens, samples=samples, progress=False).image

    def focused(self, share, largest):
        """A lens with this share of what is seen before its focus, and its image."""
        seen = self.depth[jnp.isfinite(self.depth)]
        focus = float(jnp.quantile(seen, share))
        circles = self.lens(1.0, focus).circle_of_confusion(seen)
        lens = self.lens(largest / float(circles.max()), focus)
        return lens, self.through(lens, self.samples)

    def band(self, width):
        """The pixels so near to an edge in depth."""
        inverse = 1 / self.depth
        most = lambda x, side: jax.lax.reduce_window(
            x, -jnp.inf, jax.lax.max, (side, side), (1, 1), "SAME"
        )
        edge = most(inverse, 3) > -1.05 * most(-inverse, 3)
        return most(edge.astype(inverse.dtype), 2 * width + 1) > 0


def rows(case):
    """A focus, a largest circle, and the figures of all three."""
    for (name, share), largest in itertools.product(FOCI.items(), LARGEST):
        lens, truth = case.focused(share, largest)
        band = case.band(largest // 2)
        data, room = (case.image, case.depth, lens), largest + 0.01

        def score(picture, truth=truth, band=band):
            whole = metrics.psnr(picture, truth)
            return float(whole), float(metrics.psnr(picture, truth, mask=band))

        scatter = jax.jit(ft.partial(dof.scatter, max_coc=room))
        scattered = max(
            score(scatter(*data, gamma=gamma, epsilon=epsilon))
            for gamma, epsilon in itertools.product(GAMMAS, EPSILONS)
        )
        one = score(dof.layered(*data, max_coc=room, behind=None))
        two = score(dof.layered(*data, max_coc=room, behind=case.behind))
        yield name, largest, np.array([scattered, one, two])


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="files that trimesh reads")
    parser.add_argument("--side", type=int, default=192, help="of the pictures, in pixels")
    parser.add_argument("--samples", type=int, default=384, help="passes of a reference")
    given = parser.parse_args()
    found = []
    print("scene         focus   CoC  scatter / band   one layer      two layers     two - one")
    for path in given.meshes or [None]:
        mesh = scene.still_life() if path is None else scene.load(path)
        title = "still life" if path is None else path.rpartition("/")[2]
        for name, largest, figures in rows(Case(mesh, (given.side, given.side), given.samples)):
            scattered, (one, two) = figures[0], figures[1:] - figures[0]
            found.append([*one, *two, two[0] - one[0]])
            print(
                f"{title:13} {name:6} {largest:4} {scattered[0]:7.2f} /{scattered[1]:6.2f} "
                "  {:+6.2f} /{:+6.2f} {:+6.2f} /{:+6.2f}   {:+.4f}".format(*found[-1]),
                flush=True,
            )
    for word, reduced in (("mean", np.mean), ("least", np.min)):
        print(
            f"{word:42}  {{:+6.2f}} /{{:+6.2f}} {{:+6.2f}} /{{:+6.2f}}   {{:+.4f}}".format(
                *reduced(found, axis=0)
            )
        )


if __name__ == "__main__":
    main()
