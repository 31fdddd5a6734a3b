"""Errors of `dof.layered` under wrong depth: the usual mistakes of networks.

    python -m benchmarks.depth_errors

Prints a table. The still life is in focus at its near objects, as a portrait is; the reference
looks through 256 points of the lens. Figures are errors of the image's values, root mean
square, within 8 pixels of the edges in depth.
"""

import numpy as np
from scipy import ndimage

from jaxfx import ThinLens, dof, metrics, relight, scene


HEIGHT, WIDTH = 180, 240
# Scene units: the nearest objects are 2.5 away, the wall 7.7.
APERTURE, FOCUS = 0.12, 2.6
# Pixels: how wrong a network's edges are, and how far from an edge errors are looked at.
WRONG, BAND = 2, 8
# A relative step in depth that is an edge.
STEP = 0.2


def wrong_depths(depth):
    """Depth maps with the mistakes of networks, by name."""
    size = 2 * WRONG + 1
    inverse = ndimage.gaussian_filter(1 / depth, WRONG)
    return {
        "exact": depth,
        f"objects {WRONG} pixels too wide": ndimage.minimum_filter(depth, size),
        f"objects {WRONG} pixels too narrow": ndimage.maximum_filter(depth, size),
        f"edges softened by {WRONG} pixels": 1 / inverse,
        "thin things are missing": ndimage.grey_closing(depth, 2 * size + 1),
        "scale of distances 10 % off": FOCUS + 1.1 * (depth - FOCUS),
    }


def main():
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=HEIGHT, width=WIDTH)
    lights = scene.default_lights(camera)

    def seen_by(camera):
        gbuffer = scene.gbuffer(mesh, camera, height=HEIGHT, width=WIDTH)
        return relight.render(gbuffer, camera, lights), np.asarray(gbuffer.depth)

    image, depth = seen_by(camera)
    lens = ThinLens.from_camera(camera, aperture=APERTURE, focus_distance=FOCUS)
    reference = dof.accumulate(lambda camera: seen_by(camera)[0], camera, lens).image
    low, high = (f(depth, 3) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    is_near_edge = ndimage.binary_dilation(high > (1 + STEP) * low, iterations=BAND)
    largest = float(np.max(lens.circle_of_confusion(depth)))
    print(
        f"Circles of confusion up to {largest:.1f} pixels, {is_near_edge.mean():.0%} near edges"
    )
    print("| depth | error near edges | PSNR, dB |\n|---|---:|---:|")
    for name, wrong in wrong_depths(depth).items():
        blurred = dof.layered(image, wrong, lens)
        error = np.sqrt(np.mean(np.square(blurred - reference)[is_near_edge]))
        print(f"| {name} | {error:.4f} | {metrics.psnr(blurred, reference):.1f} |")
    pinhole = np.sqrt(np.mean(np.square(image - reference)[is_near_edge]))
    print(f"| the image without blur | {pinhole:.4f} | {metrics.psnr(image, reference):.1f} |")


if __name__ == "__main__":
    main()
