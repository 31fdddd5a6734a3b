"""A moving light and a turning camera, from four cached views of a mesh.

Renders four G-buffers of a mesh, a glTF file for instance. From those alone it draws frames in
which a spot light moves before a camera that stands still, each an edit of one light; then
frames in which the camera turns, each from a G-buffer synthesized from the four. Shadows come
from a shadow map of each frame. With `--environment` the light of all surroundings is added,
and between the two it turns once about the vertical, each frame an edit of one light. Writes
`relight.gif`, `sheet.png` and `report.json`, with the time of each frame.
"""

import argparse
import json
import logging
import os
import statistics
import time
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from _begin import fail, make_folder
from PIL import Image

from jaxfx import (
    EnvironmentLight,
    PinholeCamera,
    SpotLight,
    io,
    metrics,
    relight,
    reproject,
    scene,
    shadow,
)
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


# Where the four caches stand: radians about the target, and height as a ratio to the distance.
# How far the camera turns: radians.
STATIONS = ((-0.2, 0.0), (0.2, 0.0), (0.0, 0.15), (0.0, -0.05))
TURN = 0.15
MAP_SIZE = 512
# Rows of the surroundings: a larger picture is averaged to at most this many. More show in
# mirrors alone.
SKY_ROWS = 128
# The mean radiance to which the surroundings are scaled: files come in any unit.
SKY_MEAN = 0.25


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, help="a mesh; without it, a still life")
    parser.add_argument(
        "--environment",
        nargs="?",
        const="",
        metavar="FILE",
        help="light from a panorama, .exr, .hdr, .png or .jpg, twice as wide as high, which "
        "turns; without a file, from a sky of our own",
    )
    parser.add_argument("--size", type=int, default=480, help="height of the image, pixels")
    parser.add_argument(
        "--frames",
        type=int,
        default=32,
        help="half of them for the light, or a third where surroundings turn too",
    )
    parser.add_argument(
        "--depth",
        choices=("mesh", "warp"),
        default="mesh",
        help="a new view's depth: rasterised, or warped from the caches' own",
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder to write to")
    arguments = parser.parse_args()
    for name, least in (("size", 16), ("frames", 2 if arguments.environment is None else 3)):
        if getattr(arguments, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(arguments, name)}")
    return arguments


class Stage(NamedTuple):
    """The mesh, its first camera, the point that it looks at, and the size of the image."""

    mesh: scene.Scene
    camera: PinholeCamera
    target: np.ndarray
    height: int
    width: int

    def turned(self, angle: float, rise: float) -> PinholeCamera:
        """The camera moved about the target, as far from it as before."""
        pose = np.asarray(self.camera.world_from_camera, np.float64)
        offset = pose[:3, 3] - self.target
        eye = about_vertical(angle) @ offset
        eye[1] += rise * np.linalg.norm(offset)
        eye *= np.linalg.norm(offset) / np.linalg.norm(eye)
        focal = float(self.camera.intrinsics[1, 1])
        return PinholeCamera.look_at(
            self.target + eye,
            self.target,
            up=[0, 1, 0],
            fov_y=2 * np.arctan(self.height / 2 / focal),
            height=self.height,
            width=self.width,
        )

    def gbuffer(self, camera):
        return scene.gbuffer(self.mesh, camera, height=self.height, width=self.width)

    def depth(self, camera):
        return scene.depth(self.mesh, camera, height=self.height, width=self.width)

    def light(self, phase: float) -> SpotLight:
        """A spot light on a circle above the target, phase 0 to 1."""
        radius = float(
            np.linalg.norm(np.asarray(self.camera.world_from_camera)[:3, 3] - self.target)
        )
        angle = 2 * np.pi * phase
        offset = radius * np.array([0.45 * np.cos(angle), 0.55, 0.35 + 0.25 * np.sin(angle)])
        strength = 2.2 * offset @ offset
        color = strength * np.array([1.0, 0.9, 0.75])
        return SpotLight(self.target + offset, -offset, color, 0.3, 0.55)


def set_stage(path: Path | None, height: int) -> Stage:
    """The mesh and its camera; a file that can't be used ends the program."""
    width = height * 4 // 3
    try:
        mesh = scene.still_life() if path is None else scene.load(path)
        camera = scene.default_camera(mesh, height=height, width=width)
        middle = mesh.center if mesh.viewpoint is None else np.array(mesh.viewpoint.at)
        stage = Stage(mesh, camera, middle, height, width)
        stage.gbuffer(camera)
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)
    return stage


def surroundings(path: str) -> EnvironmentLight:
    """The light of a panorama, or of a sky with a low sun; a bad file ends the program."""
    try:
        picture = panorama(path) if path else sky()
        rows = picture.shape[0]
        step = -(-rows // SKY_ROWS)
        if picture.shape[1] != 2 * rows:
            raise ValueError(
                f"{path!r} must be twice as wide as high, got {picture.shape[:2]}."
            )
        if step > 1:  # Rows that are left over, at the nadir, are dropped.
            kept = rows // step
            picture = picture[: kept * step, : 2 * kept * step, :3]
            picture = picture.reshape(kept, step, 2 * kept, step, 3).mean(axis=(1, 3))
        return EnvironmentLight(picture, color=np.full(3, SKY_MEAN / picture.mean()))
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)


def panorama(path: str) -> np.ndarray:
    """A picture of all directions, linear; negative numbers, from a resampling say, are 0."""
    picture = io.read_color(path)
    if picture.shape[2] < 3:  # Gray, and perhaps its alpha.
        picture = np.repeat(picture[..., :1], 3, axis=2)
    return np.maximum(picture[..., :3], 0)


def sky() -> np.ndarray:
    """A blue sky, a low sun behind haze, brown ground."""
    rows, columns = np.mgrid[:SKY_ROWS, : 2 * SKY_ROWS] + 0.5
    above, right = np.pi * (0.5 - rows / SKY_ROWS), np.pi * (columns / SKY_ROWS - 1)
    to_sun = np.cos(above) * np.cos(right - 0.8) * np.cos(0.4) + np.sin(above) * np.sin(0.4)
    is_up = (0.5 + 0.5 * np.tanh(6 * np.sin(above)))[..., None]
    picture = is_up * np.array([0.4, 0.6, 1.0]) + (1 - is_up) * np.array([0.25, 0.18, 0.12])
    return picture + np.exp(30 * (to_sun - 1))[..., None] * np.array([12.0, 9.5, 6.5])


def about_vertical(angle: float) -> np.ndarray:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


@jax.jit
def warped_depth(gbuffers, cameras, target):
    """The depth of a new view from the caches' depths: of the nearest surface in any of them.

    The points in the world of each cache are warped as if they were its colors.
    """
    height, width = gbuffers[0].depth.shape
    nearest = jnp.full((height, width), jnp.inf, jnp.float32)
    for gbuffer, camera in zip(gbuffers, cameras, strict=True):
        known = jnp.isfinite(gbuffer.depth)
        points = camera.points(jnp.where(known, gbuffer.depth, 1))
        image = jnp.concatenate([points, known[..., None].astype(points.dtype)], axis=-1)
        moved, alpha = reproject.warp(image, gbuffer.depth, camera, target)
        depth = target.project(moved[..., :3])[1]
        shown = (alpha > 0) & (moved[..., 3] > 0.999) & (depth > 0)
        nearest = jnp.where(shown, jnp.minimum(nearest, depth), nearest)
    return nearest


def visibility(stage: Stage, gbuffer, camera, light: SpotLight):
    """The visibility of the light, by a filtered shadow map."""
    away = np.asarray(light.direction)
    light_camera = PinholeCamera.look_at(
        light.position,
        light.position + light.direction,
        up=[0, 0, 1] if abs(away[1]) > 0.9 * np.linalg.norm(away) else [0, 1, 0],
        fov_y=2 * float(light.outer_angle) + 0.02,
        height=MAP_SIZE,
        width=MAP_SIZE,
    )
    shadow_map = scene.depth(stage.mesh, light_camera, height=MAP_SIZE, width=MAP_SIZE)
    return filtered(gbuffer, camera, shadow_map, light_camera, 2e-3 * stage.mesh.radius)


@jax.jit
def filtered(gbuffer, camera, shadow_map, light_camera, thin):
    receivers = shadow.receivers(
        gbuffer.depth, camera, light_camera, normal=gbuffer.normal, normal_offset=thin
    )
    return shadow.pcf(shadow_map, receivers, size=5, bias=thin)


class Clock:
    """The milliseconds of each step of a frame."""

    def __init__(self):
        self.steps = {}

    def __call__(self, name, function):
        started = time.perf_counter()
        result = jax.block_until_ready(function())
        self.steps[name] = 1e3 * (time.perf_counter() - started)
        return result


class Studio:
    """Four caches, and the state of the view that is shown."""

    def __init__(self, stage: Stage, depth: str, around: EnvironmentLight | None):
        self.stage, self.depth = stage, depth
        self.cameras = [stage.turned(*station) for station in STATIONS]
        self.caches = [stage.gbuffer(camera) for camera in self.cameras]
        self.lights = scene.default_lights(stage.camera)
        self.others = [*self.lights[1:]]  # The key light is the one that moves.
        if around is not None:
            self.others = [around]

    def view(self, camera, light, clock):
        """A new view: its cache is synthesized, and every light shaded."""
        stage = self.stage
        if self.depth == "mesh":
            depth = clock("depth", lambda: stage.depth(camera))
        else:
            depth = clock("depth", lambda: warped_depth(self.caches, self.cameras, camera))
        found, views = clock(
            "synthesize",
            lambda: relight.synthesize(self.caches, self.cameras, camera, depth=depth),
        )
        self.camera = camera
        self.gbuffer, holes = clock("fill", lambda: relight.fill_holes(found, views))
        lit = clock("shadow", lambda: visibility(stage, self.gbuffer, camera, light))
        lights, visible = [light, *self.others], [lit, *(None for _ in self.others)]
        self.state = clock(
            "shade",
            lambda: relight.start(self.gbuffer, camera, lights, visibilities=visible),
        )
        return clock("image", lambda: self.state.image), int(holes)

    def turn(self, angle, clock):
        """The same view with the surroundings turned: one light is edited."""
        (around,) = self.others
        assert isinstance(around, EnvironmentLight)
        turned = around.turned(about_vertical(angle))
        self.state = clock("edit", lambda: self.state.edit(1, turned))
        return clock("image", lambda: self.state.image)

    def move(self, light, clock):
        """The same view with the light elsewhere: one light is edited."""
        lit = clock("shadow", lambda: visibility(self.stage, self.gbuffer, self.camera, light))
        self.state = clock("edit", lambda: self.state.edit(0, light, lit))
        return clock("image", lambda: self.state.image)


def play(studio: Studio, frames: int) -> tuple[list, list]:
    """The image of every frame, and its record for the report."""
    stage, first = studio.stage, studio.stage.light(0.0)
    turns = isinstance(studio.others[0], EnvironmentLight)
    moved, total = (frames // 3, frames - frames // 3) if turns else (frames // 2, frames // 2)
    for _ in range(2):  # The second time nothing is left to compile.
        studio.view(stage.turned(0.0, 0.02), first, Clock())
        studio.move(first, Clock())
        if turns:
            studio.turn(0.0, Clock())
    images, records = [], []
    for frame in range(frames):
        clock, holes = Clock(), 0
        if frame < moved:
            kind, image = "edit", studio.move(stage.light(frame / moved), clock)
        elif frame < total:
            angle = 2 * np.pi * (frame - moved) / (total - moved)
            kind, image = "turned surroundings", studio.turn(angle, clock)
        else:
            kind, phase = "new view", 2 * np.pi * (frame - total) / (frames - total)
            camera = stage.turned(TURN * np.sin(phase), 0.02 + 0.03 * (1 - np.cos(phase)))
            image, holes = studio.view(camera, first, clock)
        images.append(np.asarray(image))
        records.append(
            {
                "kind": kind,
                "milliseconds": sum(clock.steps.values()),
                "steps": clock.steps,
                "holes": holes,
                "psnr": psnr_to_fresh_cache(studio, image),
            }
        )
    return images, records


def psnr_to_fresh_cache(studio: Studio, image) -> float:
    """PSNR to the image from a G-buffer rendered for the view, under the same lights."""
    truth = studio.stage.gbuffer(studio.camera)
    light = studio.state.lights[0]
    lit = visibility(studio.stage, truth, studio.camera, light)
    lights, visible = [*studio.state.lights], [lit, *(None for _ in studio.others)]
    fresh = relight.start(truth, studio.camera, lights, visibilities=visible).image
    return float(metrics.psnr(image, fresh))


def to_bytes(image) -> np.ndarray:
    return np.rint(255 * io.srgb_from_linear(np.clip(image, 0, 1))).astype(np.uint8)


def write_gif(images, path: Path) -> None:
    first, *rest = (
        Image.fromarray(to_bytes(image)).quantize(128, dither=Image.Dither.NONE)
        for image in images
    )
    buffer = BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=80, loop=0)
    write_whole(path, buffer.getvalue())


def write_sheet(images, records, path: Path) -> None:
    chosen = np.unique(np.linspace(0, len(images) - 1, 12).astype(int))
    figure, axes = plt.subplots(3, 4, figsize=(12, 7.6), layout="constrained")
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, i in zip(axes.flat, chosen, strict=False):
        record = records[i]
        ax.imshow(to_bytes(images[i]))
        ax.set_title(
            f"{record['kind']}: {record['milliseconds']:.0f} ms, {record['psnr']:.0f} dB",
            fontsize=9,
        )
    buffer = BytesIO()
    figure.savefig(buffer, dpi=100)
    write_whole(path, buffer.getvalue())
    plt.close(figure)


def summary(records) -> dict:
    """The median time of each kind of frame and of its steps."""
    kinds = {}
    for kind in dict.fromkeys(record["kind"] for record in records):
        of_kind = [record for record in records if record["kind"] == kind]
        median = lambda read, of_kind=of_kind: statistics.median(map(read, of_kind))
        kinds[kind] = {
            "milliseconds": median(lambda record: record["milliseconds"]),
            "steps": {
                step: median(lambda record, step=step: record["steps"][step])
                for step in of_kind[0]["steps"]
            },
            "psnr": median(lambda record: record["psnr"]),
        }
    return kinds


def main() -> None:
    arguments = parse()
    logging.basicConfig(format="%(message)s")
    logging.getLogger("jaxfx").setLevel(logging.INFO)
    out = make_folder(arguments.out)
    around = None if arguments.environment is None else surroundings(arguments.environment)
    studio = Studio(set_stage(arguments.scene, arguments.size), arguments.depth, around)
    images, records = play(studio, arguments.frames)
    write_gif(images, out / "relight.gif")
    write_sheet(images, records, out / "sheet.png")
    report = {
        "size": [studio.stage.height, studio.stage.width],
        "depth": arguments.depth,
        "cores": os.cpu_count(),
        "median": summary(records),
        "frames": records,
    }
    write_whole(out / "report.json", json.dumps(report, indent=2).encode())
    for kind, median in report["median"].items():
        steps = ", ".join(f"{name} {value:.1f}" for name, value in median["steps"].items())
        print(f"{kind:20}{median['milliseconds']:7.1f} ms ({steps}), {median['psnr']:.1f} dB")
    print(f"images and report in {out}")


if __name__ == "__main__":
    main()
