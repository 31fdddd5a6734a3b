"""Depth and an all-in-focus image from images at several focus distances.

Without FOLDER a still life is rendered through lenses by many passes, so that what is found can
be compared with the truth, and with the usual depth from focus (variance of the Laplacian, arg
max, a parabola). That takes minutes; `--size 160` takes a tenth of them, and errs more. With
FOLDER, its images are read in the order of their names (PNG or JPEG, sRGB, or EXR, linear),
with their lenses from `lenses.json` there:

    [{"file": "a.png", "aperture": 0.02, "focus_distance": 0.8, "focal_pixels": 3000}, ...]

Writes `image.png`, `result.exr` (image, depth, standard error), `stack.png` (the pictures in
one figure) and `report.json`.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import jax
import numpy as np
from _begin import fail, make_folder
from matplotlib.figure import Figure
from scipy import ndimage
from tqdm.auto import tqdm

from jaxfx import ThinLens, dof, exr, fit, io, metrics, relight, scene
from jaxfx._files import write_whole


# The lens of the renderings: scene units, and foci evenly spaced in inverse depth. The largest
# circle of confusion is a twentieth of the images' width.
APERTURE, NEAREST, FARTHEST, COUNT = 0.05, 1.0, 8.0, 5
# Depths between which the still life lies.
RANGE = {"min_depth": 0.75, "max_depth": 9.0}
# Where a pixel counts as textured: standard deviation of the luminance about it over the mean.
TEXTURE = 0.1
# Passes of a rendering, and which of the lens' sequences: its points spread like a disc.
SAMPLES, SEED = 256, 7


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", help="images and lenses.json")
    parser.add_argument("--size", type=int, default=640, help="width of renderings, pixels")
    parser.add_argument("--aperture", type=float, default=APERTURE, help="of renderings")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="passes of each rendering")
    parser.add_argument("--steps", type=int, default=8, help="of the search")
    parser.add_argument(
        "--find",
        choices=("aperture", "focus_distance"),
        help="of the lenses, searched for too, from those given; renderings' are a fifth off",
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder to write to")
    arguments = parser.parse_args()
    for name, least in (("size", 16), ("samples", 1), ("steps", 0)):
        if getattr(arguments, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(arguments, name)}")
    if not 0 < arguments.aperture < math.inf:
        parser.error(f"--aperture must be positive, got {arguments.aperture}")
    return arguments


def rendered(width: int, samples: int, aperture: float = APERTURE):
    """Images of the still life, their lenses, and the true image and depth."""
    height = 3 * width // 4
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=height, width=width)
    lights = scene.default_lights(camera)
    shade = jax.jit(relight.render)

    def seen(eye):
        return scene.gbuffer(mesh, eye, height=height, width=width)

    render = lambda eye: shade(seen(eye), eye, lights)
    foci = 1 / np.linspace(1 / NEAREST, 1 / FARTHEST, COUNT)
    # The same blur as a ratio to the width, whatever the size.
    lens = lambda size, focus: ThinLens.from_camera(
        camera, aperture=size, focus_distance=float(focus)
    )
    lenses = [lens(aperture, focus) for focus in foci]
    images = [
        np.asarray(dof.accumulate(render, camera, each, samples=samples, seed=SEED).image)
        for each in tqdm(lenses, desc="render", leave=False)
    ]
    sharp = np.asarray(dof.accumulate(render, camera, lens(0.0, 2.0), samples=64).image)
    return images, lenses, sharp, np.asarray(seen(camera).depth)


def read(folder: Path):
    """The images of a folder and their lenses; what can't be used ends the program."""
    try:
        entries = json.loads((folder / "lenses.json").read_text(encoding="utf-8"))
        images, lenses = [], []
        for entry in entries:
            path = folder / entry["file"]
            is_linear = path.suffix.lower() == ".exr"
            image = exr.read(path)[""] if is_linear else io.read_color(path)
            images.append(np.asarray(image, np.float32)[..., :3])
            names = ("aperture", "focus_distance", "focal_pixels")
            lenses.append(ThinLens(*(float(entry[name]) for name in names)))
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"{folder}: {type(error).__name__}: {error}")
    return images, lenses


def wrong(lenses, unknown):
    """Lenses whose apertures are a fifth too large, or foci a fifth of their steps off."""
    if unknown == "aperture":
        return [replace(lens, aperture=1.2 * lens.aperture) for lens in lenses]
    inverse = np.array([1 / float(lens.focus_distance) for lens in lenses])
    signs = np.where(np.arange(len(lenses)) % 2 == 0, 1, -1)
    inverse = inverse + 0.2 * np.ptp(inverse) / (len(lenses) - 1) * (signs - signs.mean())
    return [
        replace(lens, focus_distance=1 / at)
        for lens, at in zip(lenses, inverse.astype(np.float32), strict=True)
    ]


def depth_from_focus(images, lenses):
    """The usual method: depth, and of each pixel the sharpest image."""
    sharpness = []
    for image in images:
        edges = ndimage.laplace(image, axes=(0, 1))
        mean = ndimage.gaussian_filter(edges, (1.5, 1.5, 0))
        square = ndimage.gaussian_filter(edges**2, (1.5, 1.5, 0))
        sharpness.append(np.log((square - mean**2).sum(-1).clip(0) + 1e-12))
    sharpness = np.stack(sharpness)
    index = sharpness.argmax(0)
    inner = np.clip(index, 1, max(1, len(images) - 2))
    take = lambda at: np.take_along_axis(sharpness, at.clip(0, len(images) - 1)[None], 0)[0]
    before, at, after = (take(inner + step) for step in (-1, 0, 1))
    step = (before - after) / 2 / np.minimum(before - 2 * at + after, -1e-9)
    place = np.clip(inner + np.clip(step, -1.5, 1.5), 0, len(images) - 1)
    inverse = [1 / float(lens.focus_distance) for lens in lenses]
    depth = 1 / np.interp(place, np.arange(len(images)), inverse)
    return depth, np.take_along_axis(np.stack(images), index[None, ..., None], 0)[0]


def textured(sharp):
    """The pixels about which the true image varies."""
    luminance = sharp.mean(axis=-1)
    mean, square = (ndimage.gaussian_filter(x, 2) for x in (luminance, luminance**2))
    return np.sqrt((square - mean**2).clip(0)) > TEXTURE * mean


def compared(found, images, lenses, sharp, depth) -> dict:
    """Errors of what was found, and of the usual method, beside the truth."""
    mask, told = textured(sharp), np.asarray(found.determined)
    usual, sharpest = depth_from_focus(images, lenses)
    off = {"fit": np.asarray(found.depth), "depth from focus": usual}
    off = {name: np.abs(value - depth) / depth for name, value in off.items()}
    error = np.asarray(found.standard_errors["depth"])
    rows = {
        name: {
            "median relative error, textured": float(np.median(value[mask])),
            "median relative error, determined": float(np.median(value[mask & told])),
            "90 % below, textured": float(np.quantile(value[mask], 0.9)),
        }
        for name, value in off.items()
    }
    rows["fit"]["PSNR (dB)"] = float(metrics.psnr(found.image, sharp))
    rows["depth from focus"]["PSNR (dB)"] = float(metrics.psnr(sharpest, sharp))
    within = off["fit"] * depth < 1.96 * error
    return rows | {
        "textured": float(mask.mean()),
        "within 1.96 standard errors": float(within[told].mean()),
    }


def draw(found, images, sharp, depth, path: Path) -> None:
    """The pictures in one figure."""
    shown = lambda image: io.srgb_from_linear(np.clip(np.asarray(image), 0, 1))
    error = np.asarray(found.standard_errors["depth"]) / np.asarray(found.depth)
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    panels = [
        ("nearest focus", shown(images[0]), {}),
        ("farthest focus", shown(images[-1]), {}),
        ("all in focus", shown(found.image), {}),
        ("1 / depth", 1 / np.asarray(found.depth), {"cmap": "magma"}),
        ("standard error / depth", error, {"cmap": "viridis", "vmin": 0, "vmax": 0.1}),
    ]
    if depth is None:
        panels.append(("determined", np.asarray(found.determined), {"cmap": "gray"}))
    else:
        off = np.abs(np.asarray(found.depth) / depth - 1)
        panels.append(("error / depth", off, {"cmap": "viridis", "vmin": 0, "vmax": 0.1}))
    for axis, (title, panel, options) in zip(axes, panels, strict=True):
        drawn = axis.imshow(panel, **options)
        axis.set(title=title, xticks=[], yticks=[])
        if options and options["cmap"] != "gray":
            figure.colorbar(drawn, ax=axis, shrink=0.8)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110)
    write_whole(path, buffer.getvalue())


def main() -> None:
    arguments = parse()
    out = make_folder(arguments.out)
    sharp = depth = None
    unknown = arguments.find
    parameters = set() if unknown is None else {unknown}
    if arguments.folder is None:
        images, lenses, sharp, depth = rendered(
            arguments.size, arguments.samples, arguments.aperture
        )
        start = lenses if unknown is None else wrong(lenses, unknown)
    else:
        images, start = read(arguments.folder)
        lenses = None
    started = time.perf_counter()
    options = {"max_steps": arguments.steps, "throw": False, "progress": True}
    options |= RANGE if arguments.folder is None else {}
    try:
        found = fit.focal_stack(images, start, parameters=parameters, **options)
    except ValueError as error:
        fail(error)
    report = {
        "seconds": time.perf_counter() - started,
        "size": list(found.depth.shape),
        "determined": float(found.share),
        "explained": float(found.explained),
        "doubt": found.doubt,
    }
    if unknown is not None:
        numbers = lambda some: [float(getattr(lens, unknown)) for lens in some]
        report[unknown] = {
            "start": numbers(start),
            "found": numbers(found.lenses),
            "standard error": np.asarray(found.standard_errors[unknown]).tolist(),
        }
        if lenses is not None:
            report[unknown]["true"] = numbers(lenses)
    error = np.asarray(found.standard_errors["depth"])
    io.write_png(out / "image.png", np.clip(found.image, 0, 1))
    exr.write(
        out / "result.exr",
        {"": found.image, "depth": found.depth, "error.depth": error},
    )
    if sharp is not None:
        report |= compared(found, images, lenses, sharp, depth)
    draw(found, images, sharp, depth, out / "stack.png")
    finite = {
        k: v if not isinstance(v, float) or math.isfinite(v) else None
        for k, v in report.items()
    }
    write_whole(out / "report.json", json.dumps(finite, indent=2, allow_nan=False).encode())
    for name, value in report.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()
