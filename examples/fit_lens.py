"""From a mesh to a fitted lens.

Renders a mesh with its depth, renders it through a lens by many passes as the reference, and
fits the lens, gamma and epsilon of `dof.scatter` to that reference, from a start that is wrong
on purpose. Writes `reference.exr`, `fitted.exr`,
`fit.png`, `chart.png` and `report.json`.
"""

import argparse
import json
import logging
import math
import os
import time
from io import BytesIO
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from _begin import fail, make_folder

from jaxfx import ThinLens, dof, exr, fit, io, metrics, relight, reproject, scene, tradeoff
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


# The largest circle of confusion of the reference's lens, as a ratio to the image's side.
LARGEST_COC = 0.04
# Passes that antialias the pinhole image.
PINHOLE_PASSES = 16
# The labels of the chart's lines.
MULTI, WHOLE = "multi-pass", "pinhole passes, then scatter"
REPROJECTED = "reprojected, passes"


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, help="a mesh; without it, a still life")
    parser.add_argument("--size", type=int, default=320, help="side of the image, pixels")
    parser.add_argument("--samples", type=int, default=256, help="passes of the reference")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="of the start and of the passes")
    arguments = parser.parse_args()
    for name, least in (("size", 16), ("samples", 4), ("seed", 0)):
        if getattr(arguments, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(arguments, name)}")
    return arguments


def load(path: Path | None, size: int):
    """The scene, its camera, lights and depth; a file that can't be used ends the program."""
    try:
        mesh = scene.still_life() if path is None else scene.load(path)
        camera = scene.default_camera(mesh, height=size, width=size)
        depth = scene.gbuffer(mesh, camera, height=size, width=size).depth
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)
    return mesh, camera, scene.default_lights(camera), depth


def lens_for(camera, depth) -> ThinLens:
    """A lens focused at the first third of visible depths, as wide as LARGEST_COC asks."""
    visible = depth[jnp.isfinite(depth)]
    if jnp.max(visible) < 1.001 * jnp.min(visible):
        fail("all that is seen lies at one depth, nothing is blurred")
    focus = jnp.quantile(visible, 1 / 3)
    unit = ThinLens.from_camera(camera, aperture=1.0, focus_distance=focus)
    largest = jnp.max(unit.circle_of_confusion(visible))
    aperture = LARGEST_COC * min(depth.shape) / largest
    return ThinLens(aperture, unit.focus_distance, unit.focal_pixels)


def without_holes(depth):
    """The depth, with the farthest visible one in place of the background.

    The circles of confusion of a depth of inf are larger than any other: scatter, which has no
    occlusion, would spread the black of the background over all that is out of focus.
    """
    return jnp.minimum(depth, jnp.max(jnp.where(jnp.isfinite(depth), depth, 0)))


def wrong_start(lens: ThinLens, seed: int) -> dict:
    """A lens 40 % and 15 % off, gamma and epsilon by 2.5; the seed decides the directions."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 4)
    return {
        "lens": ThinLens(
            lens.aperture * (1 + 0.4 * signs[0]),
            lens.focus_distance * (1 + 0.15 * signs[1]),
            lens.focal_pixels,
        ),
        "gamma": 1.0 * 2.5 ** signs[2],
        "epsilon": 2.0 * 2.5 ** signs[3],
    }


def numbers(lens: ThinLens, **amplifications) -> dict[str, float]:
    values = {"aperture": lens.aperture, "focus_distance": lens.focus_distance}
    return {name: float(value) for name, value in (values | amplifications).items()}


def near_edges(depth, radius: int):
    """The pixels within a radius of a jump in depth of 5 %; None if there is none."""

    def largest(x, side):
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (side, side), (1, 1), "SAME")

    inverse = 1 / depth
    jump = largest(inverse, 3) > 1.05 * -largest(-inverse, 3)
    mask = largest(jump.astype(depth.dtype), 2 * radius + 1) > 0
    return mask if mask.any() else None


def contenders(multi_pass, pinhole, reprojected, scatter, layered, image, samples: int) -> dict:
    """The methods of the chart; the first three take a count of passes."""
    # Compile first: every timed call then takes the same time.
    jax.block_until_ready((scatter(image), layered(image), reprojected(1)))
    counts = [*(2**k for k in range(2, math.ceil(math.log2(samples)))), samples]
    # The image that scatter is given has its price too, which grows with its antialiasing.
    return (
        {
            "scatter of a given image": lambda: scatter(image),
            "layered of a given image": lambda: layered(image),
        }
        | {f"{REPROJECTED} {n}": lambda n=n: reprojected(n) for n in (4, 16, 64)}
        | {f"{WHOLE} {n}": lambda n=n: scatter(pinhole(n)) for n in (1, 4, PINHOLE_PASSES)}
        | {f"{MULTI} {n}": lambda n=n: multi_pass(n) for n in counts}
    )


def draw_chart(measurements, title: str, path: Path) -> None:
    names = [measurement.name for measurement in measurements]
    labels = MULTI, WHOLE, REPROJECTED
    lines = {label: [n for n in names if n.startswith(label)] for label in labels}
    figure, ax = plt.subplots(figsize=(8, 5.5), layout="constrained")
    tradeoff.plot(measurements, ax, lines=lines)
    ax.set_title(title)
    save(figure, path)


def draw_fit(images: dict, losses, path: Path) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(12, 8.4), layout="constrained")
    for ax, (title, image) in zip(axes.flat, images.items(), strict=False):
        ax.imshow(io.srgb_from_linear(np.clip(np.asarray(image), 0, 1)))
        ax.set_title(title)
        ax.set_axis_off()
    ax, losses = axes.flat[-1], np.asarray(losses)
    ax.semilogy(losses, ".-", label="the search")
    # Within one search a step is taken only where it lowers the loss.
    for again in 1 + np.flatnonzero(np.diff(losses) > 0):
        ax.axvline(again, color="0.6", linestyle=":", label="starts again")
    ax.legend(*(each[:2] for each in ax.get_legend_handles_labels()))
    ax.set(title="mean squared residual", xlabel="step", box_aspect=1)
    ax.yaxis.tick_right()
    ax.grid(alpha=0.3)
    save(figure, path)


def save(figure, path: Path) -> None:
    buffer = BytesIO()
    figure.savefig(buffer, dpi=130)
    plt.close(figure)
    write_whole(path, buffer.getvalue())


def print_table(report: dict) -> None:
    print(f"{'':16}{'reference':>12}{'start':>12}{'fitted':>12}{'± std. error':>16}")
    for name in fit.PARAMETERS:
        known = f"{report['true'][name]:12.4g}" if name in report["true"] else f"{'':12}"
        fitted, error = report[name], report["standard_errors"][name]
        print(f"{name:16}{known}{report['start'][name]:12.4g}{fitted:12.4g}{error:16.2g}")
    print(f"{'PSNR (dB)':28}{report['psnr_start']:12.2f}{report['psnr_fitted']:12.2f}")
    print(f"{'pinhole (dB)':28}{report['psnr_pinhole']:12.2f}")
    if not report["converged"]:
        print("The search ended before it converged; its last values are shown.")


def strict(value):
    """The value for JSON, which has null in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    started = time.perf_counter()
    arguments = parse()
    logging.basicConfig(format="%(message)s")
    logging.getLogger("jaxfx").setLevel(logging.INFO)
    out = make_folder(arguments.out)
    size, samples, seed = arguments.size, arguments.samples, arguments.seed
    mesh, camera, lights, depth = load(arguments.scene, size)
    shade = jax.jit(relight.render)

    def render(camera):
        return shade(scene.gbuffer(mesh, camera, height=size, width=size), camera, lights)

    lens = lens_for(camera, depth)

    def accumulate(aperture, count, seed, progress=False):
        eye = ThinLens(aperture, lens.focus_distance, lens.focal_pixels)
        options = {"samples": count, "seed": seed, "progress": progress}
        return dof.accumulate(render, camera, eye, **options)

    # A lens of no aperture: a pinhole image, antialiased as the reference is.
    image = accumulate(0.0, PINHOLE_PASSES, seed).image
    reference = accumulate(lens.aperture, samples, seed, progress=True)
    exr.write(out / "reference.exr", {"": reference.image, "depth": depth})

    filled = without_holes(depth)
    start = wrong_start(lens, seed)
    fitted = fit.dof(reference.image, image, filled, throw=False, progress=True, **start)
    exr.write(out / "fitted.exr", {"": fitted.image, "depth": depth})

    images = {
        "pinhole": image,
        "start": dof.scatter(image, filled, **start),
        "fitted": fitted.image,
    }
    psnr = {name: float(metrics.psnr(image, reference.image)) for name, image in images.items()}
    titles = {name: f"{name}, {psnr[name]:.1f} dB" for name in images}
    draw_fit(
        {
            titles["pinhole"]: image,
            f"reference, {samples} passes": reference.image,
            titles["fitted"]: fitted.image,
            titles["start"]: images["start"],
            "fitted, 4 times its error": 4 * jnp.abs(fitted.image - reference.image),
        },
        fitted.losses,
        out / "fit.png",
    )

    def scatter(image):
        return dof.scatter(
            image, filled, fitted.lens, gamma=fitted.gamma, epsilon=fitted.epsilon
        )

    # New views from points of the lens, from the image and its depth alone.
    @jax.jit
    def view_from(eye):
        return jnp.dstack(reproject.warp(image, filled, camera, eye))

    def reprojected(count):
        options = {"samples": count, "jitter": False, "progress": False}
        *color, alpha = jnp.moveaxis(
            dof.accumulate(view_from, camera, lens, **options).image, -1, 0
        )
        return jnp.stack(color, axis=-1) / jnp.maximum(alpha[..., None], 1 / count)

    coc = float(jnp.max(fitted.lens.circle_of_confusion(filled)))
    methods = contenders(
        # Another seed than the reference's: with its own passes the error would be too small.
        lambda count: accumulate(lens.aperture, count, seed + 1).image,
        lambda count: accumulate(0.0, count, seed + 1).image,
        reprojected,
        scatter,
        lambda image: dof.layered(image, filled, lens),
        image,
        samples,
    )
    edges = near_edges(depth, math.ceil(coc / 2))
    # Their memory would be that of one program for all passes, which is never compiled.
    measurements = tradeoff.measure(
        methods, reference.image, mask=edges, memory=False, progress=True
    )
    title = f"{size} by {size} pixels, largest circle of confusion {coc:.0f} pixels"
    draw_chart(measurements, title, out / "chart.png")

    report = {f"psnr_{name}": value for name, value in psnr.items()}
    report |= numbers(fitted.lens, gamma=fitted.gamma, epsilon=fitted.epsilon)
    report |= {
        "true": numbers(lens),
        "start": numbers(**start),
        "standard_errors": {
            name: float(value) for name, value in fitted.standard_errors.items()
        },
        "converged": fitted.success,
        "convergence": float(reference.convergence),
        "largest_coc": coc,
        "chart": [measurement._asdict() for measurement in measurements],
        "size": size,
        "samples": samples,
        "seed": seed,
        "cores": os.cpu_count(),
        "seconds": time.perf_counter() - started,
    }
    print_table(report)
    text = json.dumps(strict(report), indent=2, allow_nan=False)
    write_whole(out / "report.json", text.encode())
    print(f"{report['seconds']:.0f} s; images and report in {out}")


if __name__ == "__main__":
    main()
