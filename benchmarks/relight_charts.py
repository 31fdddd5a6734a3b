"""Relighting beside Mitsuba, as images, and the error of the bounce against its rank.

`python -m benchmarks.relight_charts --out docs` writes `relight_truth.png`,
`relight_bounce.png` and `relight_bounce.csv`, in some three minutes.
"""

import argparse
import csv
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from PIL import Image

from benchmarks.scenes import relight_truth as truth
from jaxfx import Transfer, io, metrics, relight, scene


SIZE = (72, 96)
POINTS = (256, 1024, 4096)
SAMPLES = 512


def shown(ax, title, image):
    ax.imshow(io.srgb_from_linear(np.clip(np.asarray(image), 0, 1)))
    ax.set_title(title, fontsize=9)
    ax.set_axis_off()


def save(figure, path):
    """As an image of 128 colours, which is small."""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=120)
    Image.open(stream).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path)


def direct(mesh, camera, gbuffer, path):
    lights = [*truth.LIGHTS.values()]
    visible = [truth.shadow_of(mesh, gbuffer, camera, light) for light in lights]
    pairs = {}
    for name, shadows in (("without shadows", None), ("with shadows", visible)):
        image = relight.start(gbuffer, camera, lights, visibilities=shadows).image
        traced = [
            truth.direct(mesh, camera, v, SIZE, shadows=shadows is not None) for v in lights
        ]
        pairs[name] = np.asarray(image), np.sum(traced, axis=0)
    figure, axes = plt.subplots(2, 3, figsize=(7.0, 3.9), layout="constrained")
    for row, (name, (image, traced)) in zip(axes, pairs.items(), strict=True):
        score = float(metrics.psnr(image, traced))
        off = np.mean(np.abs(image - traced).max(axis=-1) > 1e-3 * traced.max())
        print(f"{name}: {score:.1f} dB, {off:.2%} of the pixels off by a thousandth")
        how = "shadow maps" if name == "with shadows" else "no shadows"
        shown(row[0], f"Mitsuba, {name}", traced / 2)
        shown(row[1], f"relit, {how}: {score:.1f} dB", image / 2)
        shown(row[2], f"error; {off:.1%} of the pixels", np.abs(image - traced) / 2)
    save(figure, path)


def bounce(mesh, camera, gbuffer, path):
    """Rows of points, rank, and the error to the path tracer and to the full matrix."""
    light = truth.LIGHTS["directional"]
    traced, noise = truth.bounced(mesh, camera, light, SIZE, SAMPLES)
    size = lambda image: float(np.sqrt(np.mean(np.square(image))))
    rows, images = [], {}
    for points in POINTS:
        most = min(points, 1024)
        full = scene.transfer(mesh, gbuffer, camera, point_count=points, rank=most)
        lit = truth.unshadowed(mesh, full.position, light)
        send = lambda rank, full=full, lit=lit: np.asarray(
            relight.indirect(gbuffer, truncated(full, rank), [light], visibilities=[lit])
        )
        images[points] = whole = send(most)
        for rank in 2 ** np.arange(int(np.log2(most)) + 1):
            image = send(int(rank))
            errors = size(image - traced) / size(traced), size(image - whole) / size(whole)
            rows.append((points, int(rank), *errors))
    figure = plt.figure(figsize=(7.6, 3.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.2))
    pictures = left.subplots(2, 1)
    shown(pictures[0], f"one bounce, Mitsuba, {SAMPLES} paths (3 times)", 3 * traced)
    shown(pictures[1], f"from {POINTS[-1]} points (3 times)", 3 * images[POINTS[-1]])
    ax = right.subplots()
    for color, points in enumerate(POINTS):
        at = [row for row in rows if row[0] == points]
        ranks = [row[1] for row in at]
        style = {"color": f"C{color}", "marker": "."}
        ax.plot(ranks, [row[2] for row in at], label=f"{points} points", **style)
        ax.plot(ranks[:-1], [row[3] for row in at][:-1], linestyle=":", alpha=0.6, **style)
    ax.axhline(size(noise) / size(traced), color="0.5", linestyle="--", label="Mitsuba's noise")
    ax.set(xlabel="rank", ylabel="error, RMS, of the bounce", xscale="log", yscale="log")
    ax.set_title("to the path tracer; dotted: to the full matrix", fontsize=9)
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    save(figure, path)
    print(f"noise {size(noise) / size(traced):.3f}")
    return rows


def truncated(transfer, rank):
    send, receive = transfer.send[:rank], transfer.receive[..., :rank]
    return Transfer(receive, send, transfer.position, transfer.normal, transfer.diffuse)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for csv and pictures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=SIZE[0], width=SIZE[1])
    gbuffer = truth.lambert(mesh, camera, SIZE)
    direct(mesh, camera, gbuffer, out / "relight_truth.png")
    rows = bounce(mesh, camera, gbuffer, out / "relight_bounce.png")
    with open(out / "relight_bounce.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["points", "rank", "error_to_path_tracer", "error_to_full_rank"])
        writer.writerows((*row[:2], *(f"{v:.4g}" for v in row[2:])) for row in rows)


if __name__ == "__main__":
    main()
