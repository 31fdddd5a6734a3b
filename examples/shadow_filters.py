"""Shadows filtered everywhere, and only at their edges.

Renders a mesh under one directional light with a shadow map, and shows percentage-closer
filtering step by step: the hard shadow, its edges, the edges dilated, and the image filtered
there alone (`steps.png`). Then, for every size of filter, it shows the full filter beside the
masked ones, with the number of comparisons, the time, and the number of pixels that differ from
the full filter (`sizes.png`, `report.json`).
"""

import argparse
import json
import logging
import os
import statistics
import time
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from _begin import fail, make_folder
from tqdm.auto import tqdm

from jaxfx import AmbientLight, DirectionalLight, io, relight, scene, shadow
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


FULL, SCREEN, DEPTH = "full", "screen mask", "depth mask"
# Timed calls, of which the median is reported.
ROUNDS = 9


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--scene", type=Path, help="a mesh; without it, a still life")
    add("--size", type=int, default=512, help="side of the image, pixels")
    add("--map-size", type=int, default=1024, help="side of the shadow map, texels")
    add("--filters", type=int, nargs="+", default=[3, 5, 7], help="their sides, odd, texels")
    add(
        "--dilation",
        type=int,
        help="pixels by which edges reach under the screen mask; without it, half the filter "
        "and one more, which is enough where a pixel is a texel wide or wider",
    )
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    arguments = parser.parse_args()
    for name, least in (("size", 16), ("map_size", 16), ("dilation", 1)):
        value = getattr(arguments, name)
        if value is not None and value < least:
            option = name.replace("_", "-")
            parser.error(f"--{option} must be at least {least}, got {value}")
    for size in arguments.filters:
        if size < 1 or size % 2 == 0:
            parser.error(f"--filters must be odd numbers from 1, got {size}")
    return arguments


class Stage(NamedTuple):
    """The shadow map, its receivers, and images by the light (`lit`), without it (`dark`)."""

    shadow_map: jax.Array
    receivers: shadow.Receivers
    bias: jax.Array
    lit: np.ndarray
    dark: np.ndarray

    def picture(self, visible) -> np.ndarray:
        """The image under the shadow, as bytes."""
        linear = self.dark + np.asarray(visible)[..., None] * self.lit
        return np.rint(255 * io.srgb_from_linear(np.clip(linear, 0, 1))).astype(np.uint8)


def set_stage(path: Path | None, size: int, map_size: int) -> Stage:
    """A mesh before a camera and a light; a file that can't be used ends the program."""
    try:
        mesh = scene.still_life() if path is None else scene.load(path)
        camera = scene.default_camera(mesh, height=size, width=size)
        gbuffer = scene.gbuffer(mesh, camera, height=size, width=size)
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)
    turn = np.asarray(camera.world_from_camera)[:3, :3]
    key = DirectionalLight(turn @ [0.6, 0.7, 0.55], [0.8, 0.76, 0.7])

    # The map covers a ball about the visible points, and as much again towards the light.
    seen = np.isfinite(gbuffer.depth)
    depth = jnp.where(seen, gbuffer.depth, 1)
    points = np.asarray(camera.points(depth))[seen]
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - center, axis=-1).max())
    (light_camera,) = shadow.light_cameras(
        key, map_size=map_size, scene_center=center, scene_radius=radius
    )
    shadow_map = scene.depth(mesh, light_camera, height=map_size, width=map_size)
    receivers = shadow.receivers(gbuffer.depth, camera, light_camera, normal=gbuffer.normal)

    lit = relight.render(gbuffer, camera, [key])
    dark = relight.render(gbuffer, camera, [AmbientLight([0.2, 0.21, 0.24])])
    bias = jnp.asarray(1e-3 * radius, receivers.z.dtype)
    return Stage(shadow_map, receivers, bias, np.asarray(lit), np.asarray(dark))


def options(size: int, dilation: int | None) -> dict[str, dict[str, Any]]:
    """The options of every method; a bias that grows with the slope keeps a plane lit."""
    same = {"size": size, "slope_bias": size / 2}
    screen = {"edges": "screen", "dilation": dilation or size // 2 + 1}
    return {FULL: same, DEPTH: same | {"edges": "depth"}, SCREEN: same | screen}


def timed(stage: Stage, function, **options):
    """The result of a compiled call, and the median of its milliseconds."""
    data = stage.shadow_map, stage.receivers, stage.bias
    program = jax.jit(lambda m, r, bias: function(m, r, bias=bias, **options)).lower(*data)
    program, times = program.compile(), []
    result = program(*data)
    for _ in range(ROUNDS):
        started = time.perf_counter()
        jax.block_until_ready(program(*data))
        times.append(1e3 * (time.perf_counter() - started))
    return result, statistics.median(times)


def compare(stage: Stage, size: int, dilation: int | None) -> tuple[dict, list[dict]]:
    """Visibilities and masks of one size of filter, by method, and their records."""
    pictures, records = {}, []
    for method, how in options(size, dilation).items():
        function = shadow.pcf if method == FULL else shadow.edge_pcf
        visible, milliseconds = timed(stage, function, **how)
        where, comparisons = np.ones(visible.shape, bool), visible.size * size**2
        if method != FULL:
            where, comparisons = map(
                np.asarray,
                shadow.candidates(stage.shadow_map, stage.receivers, bias=stage.bias, **how),
            )
        pictures[method] = np.asarray(visible), where
        records.append(
            {
                "filter": size,
                "method": method,
                "milliseconds": milliseconds,
                "comparisons": int(comparisons),
                "filtered": float(where.mean()),
                "differing": int(np.sum(pictures[method][0] != pictures[FULL][0])),
                "dilation": how.get("dilation"),
            }
        )
    return pictures, records


def marked(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The image in gray, with the pixels of a mask in red."""
    grey = 0.6 * picture.mean(axis=-1, keepdims=True) + 100
    return np.where(where[..., None], [220, 30, 30], grey).astype(np.uint8)


def draw_steps(stage: Stage, size: int, visible, where, path: Path) -> None:
    """Draw the steps of the screen mask, from the hard shadow to the filtered one."""
    bias = {"bias": stage.bias, "slope_bias": size / 2}
    data = stage.shadow_map, stage.receivers
    hard = stage.picture(shadow.hard(*data, **bias))
    edges = shadow.candidates(*data, size=size, edges="screen", dilation=1, **bias).where
    steps = {
        "hard shadow": hard,
        "its edges": marked(hard, np.asarray(edges)),
        f"dilated for {size} x {size}": marked(hard, where),
        "filtered there": stage.picture(visible),
    }
    figure, axes = plt.subplots(2, 2, figsize=(10, 10.4), layout="constrained")
    for ax, (title, image) in zip(axes.flat, steps.items(), strict=True):
        show(ax, image, title)
    save(figure, path)


def draw_sizes(stage: Stage, every: list[tuple[dict, list[dict]]], path: Path) -> None:
    """Draw a row for each size: the full filter, and the mask of each of the others."""
    rows = len(every)
    figure, axes = plt.subplots(
        rows, 3, figsize=(12, 4.5 * rows), layout="constrained", squeeze=False
    )
    for line, (pictures, records) in zip(axes, every, strict=True):
        for ax, record in zip(line, records, strict=True):
            visible, where = pictures[record["method"]]
            image = stage.picture(visible)
            title = f"{record['filter']} x {record['filter']}, {record['method']}: "
            title += f"{record['milliseconds']:.1f} ms\n{record['comparisons']:,} comparisons"
            if record["method"] != FULL:
                image = marked(image, where)
                title += f", {record['differing']:,} pixels differ"
            show(ax, image, title)
    save(figure, path)


def show(ax, image: np.ndarray, title: str) -> None:
    ax.imshow(image)
    ax.set_title(title, fontsize=10)
    ax.set_axis_off()


def save(figure, path: Path) -> None:
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110)
    plt.close(figure)
    write_whole(path, buffer.getvalue())


def main() -> None:
    arguments = parse()
    logging.basicConfig(format="%(message)s")
    logging.getLogger("jaxfx").setLevel(logging.INFO)
    out = make_folder(arguments.out)
    stage = set_stage(arguments.scene, arguments.size, arguments.map_size)
    sizes = sorted(set(arguments.filters))
    every = [
        compare(stage, size, arguments.dilation) for size in tqdm(sizes, "size", leave=False)
    ]
    visible, where = every[-1][0][SCREEN]
    draw_steps(stage, sizes[-1], visible, where, out / "steps.png")
    draw_sizes(stage, every, out / "sizes.png")
    records = [record for _, of_size in every for record in of_size]
    report = {
        "size": arguments.size,
        "map_size": arguments.map_size,
        "cores": os.cpu_count(),
        "filters": records,
    }
    write_whole(out / "report.json", json.dumps(report, indent=2).encode())
    for record in records:
        print(
            f"{record['filter']:3} {record['method']:12}{record['milliseconds']:8.1f} ms"
            f"{record['comparisons']:14,} comparisons{record['differing']:8,} pixels differ"
        )
    print(f"images and report in {out}")


if __name__ == "__main__":
    main()
