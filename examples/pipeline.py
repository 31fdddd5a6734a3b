"""From a mesh to a picture through every effect, and from a picture back to its parameters.

A mesh is rendered into deep frame buffers by a few cameras. Then one compiled function makes a
picture of them: the frame buffer of a new camera (`relight.synthesize`), a key light with its
shadow, and depth of field (`dof.scatter`). It is differentiated end to end in the camera (eye
and turn), the key light (direction and colour) and the lens (aperture and focus distance), and
Levenberg-Marquardt searches for all of them at once from one picture, which was made from the
mesh itself, not from the buffers. On the still life the search comes near the camera and the
light, and not to the lens: what the buffers lack is as large as what the lens changes. Writes
the stages (`stages.png`), the derivatives (`derivatives.png`), the fit (`fit.png`) and the
numbers (`report.json`); prints the time of every stage.
"""

import argparse
import io
import json
import logging
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from tqdm.auto import tqdm

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    ThinLens,
    dof,
    exr,
    fit,
    relight,
    reproject,
    scene,
    shadow,
)
from jaxfx._sampling import pixel_centers
from jaxfx.exr.layers import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


# Where the cameras of the frame buffers stand, and the picture's own, from the scene's camera:
# right, down and forward, in distances to what is in focus.
CACHES = ((0.0, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.12, -0.05, 0.0))
WIDER, FINER = 1.3, 2
EYE, TURN = (0.012, -0.008, 0.015), (0.007, -0.009, 0.006)
TILT = (0.12, -0.1)
# The largest circle of confusion, as a share of the picture's height; the focus distance, of
# the median depth.
BLUR, FOCUS = 0.08, 0.65
COLOR, AMBIENT = (1.0, 0.92, 0.8), (0.2, 0.21, 0.24)
# The depth of holes, in distances to the focus.
FAR = 1e4
# A step in depth from pixel to pixel, of the depth, that is an edge.
JUMP = 0.05
REFLECTANCES = ("ambient", "diffuse", "specular", "normal")
# Of the lens, in a search that is too smooth to tell a blur.
PULL = 10.0
# Calls of which the median time is taken.
CALLS = 5


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--scene", type=Path, help="a mesh; without it, a still life")
    add("--height", type=int, default=120, help="of the picture, pixels; 4 : 3 wide")
    add("--map-size", type=int, default=256, help="side of the shadow map, texels")
    add("--rounds", type=int, default=3, help="searches, each with the last one's shadow map")
    add("--steps", type=int, default=40, help="of Levenberg-Marquardt, in each round")
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    arguments = parser.parse_args()
    for name, least in (("height", 24), ("map_size", 16), ("rounds", 1), ("steps", 1)):
        if (value := getattr(arguments, name)) < least:
            parser.error(f"--{name.replace('_', '-')} must be at least {least}, got {value}")
    return arguments


def fail(message: object) -> NoReturn:
    sys.exit(f"pipeline.py: error: {message}")


def make_folder(folder: Path) -> Path:
    """The folder, made if need be; said now rather than after the work."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        fail(f"--out must be a folder to write to: {error}")
    return folder


class Unknowns(NamedTuple):
    """What is fitted: 13 numbers, each about as large as its change changes the picture.

    - `eye`: 3, the camera's place on its own axes, in distances to the focus at the start.
    - `turn`: 3, radians about these axes.
    - `tilt`: 2, of the light's direction to the right and down, as slopes.
    - `color`: 3, logarithms of the light's colour.
    - `aperture`, `focus`: logarithms of scene units.
    """

    eye: Float[Array, "3"]
    turn: Float[Array, "3"]
    tilt: Float[Array, "2"]
    color: Float[Array, "3"]
    aperture: Float[Array, ""]
    focus: Float[Array, ""]


class Shadow(NamedTuple):
    """A map, and the camera at the light that it was made with."""

    depth: Float[Array, "rows columns"]
    camera: PinholeCamera | OrthographicCamera


class Stage(eqx.Module):
    """What the picture is made of beside its parameters."""

    caches: list[GBuffer]
    cameras: list[PinholeCamera]
    base: PinholeCamera
    direction: Float[Array, "3"]
    distance: Float[Array, ""]
    softness: Float[Array, ""]
    shape: tuple[int, int] = eqx.field(static=True)
    max_coc: float = eqx.field(static=True)

    def camera(self, unknowns: Unknowns) -> PinholeCamera:
        cosines, sines = jnp.cos(unknowns.turn), jnp.sin(unknowns.turn)
        turn = jnp.eye(3)
        for axis in range(3):
            one, other = (axis + 1) % 3, (axis + 2) % 3
            about = jnp.eye(3).at[(one, other), (one, other)].set(cosines[axis])
            about = about.at[other, one].set(sines[axis]).at[one, other].set(-sines[axis])
            turn = turn @ about
        moved = jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(self.distance * unknowns.eye)
        return PinholeCamera(self.base.intrinsics, self.base.world_from_camera @ moved)

    def light(self, unknowns: Unknowns) -> DirectionalLight:
        axes = self.base.world_from_camera[:3, :2]
        direction = self.direction + axes @ unknowns.tilt
        return DirectionalLight(direction, jnp.exp(unknowns.color))

    def lens(self, unknowns: Unknowns) -> ThinLens:
        camera = self.camera(unknowns)
        aperture, focus = jnp.exp(unknowns.aperture), jnp.exp(unknowns.focus)
        return ThinLens.from_camera(camera, aperture=aperture, focus_distance=focus)


def with_points(cache: GBuffer, camera: PinholeCamera) -> GBuffer:
    """The frame buffer with its world points for a colour, which shading does not read."""
    height, width = cache.depth.shape
    depth = jnp.where(jnp.isfinite(cache.depth), cache.depth, 1)
    points = camera.unproject(pixel_centers(height, width, depth.dtype), depth)
    return eqx.tree_at(lambda c: c.color, cache, points)


@eqx.filter_jit
def new_view(stage: Stage, camera: PinholeCamera) -> GBuffer:
    """The frame buffer of another camera, from the caches, and how it moves with the camera.

    The depth is the caches' own, reprojected; `synthesize` reads the rest.
    """
    here = jax.lax.stop_gradient(camera)
    caches = [with_points(*pair) for pair in zip(stage.caches, stage.cameras, strict=True)]
    depths = [cache.depth for cache in caches]
    points, alpha = reproject.blend(
        [cache.color for cache in caches], depths, stage.cameras, here, shape=stage.shape
    )
    # A hole lies beyond everything, until it is filled: then it is where its neighbour is.
    known = alpha > 0
    depth = jnp.where(known, here.project(points)[1], FAR * stage.distance)
    made, coverage = relight.synthesize(caches, stage.cameras, here, depth=depth)
    made, _ = relight.fill_holes(made, coverage)
    points = jnp.where(known[..., None], points, made.color)
    return moving(eqx.tree_at(lambda made: made.color, made, points), camera)


def moving(made: GBuffer, camera: PinholeCamera) -> GBuffer:
    """The same frame buffer, which moves when the camera does.

    `synthesize` reads caches at their nearest pixels: it has no derivative along the picture.
    Here each pixel moves with the point that it shows, by the picture's own slopes (Lucas &
    Kanade 1981). Missing: what comes into sight, and where depth jumps, how points move.
    """
    points, shown = made.color, made.shader >= 0
    pixels, depth = camera.project(points)
    step = jax.lax.stop_gradient(pixels) - pixels  # nothing, but for its derivative

    def moved(image, counts: Any = 1.0):
        down, across = jnp.gradient(image, axis=(0, 1))
        return image + counts * (across * step[..., :1] + down * step[..., 1:])

    down, across = jnp.gradient(jax.lax.stop_gradient(depth))
    smooth = jnp.maximum(jnp.abs(down), jnp.abs(across)) < JUMP * depth
    points = moved(points, smooth[..., None].astype(depth.dtype))
    fields = {name: moved(getattr(made, name)) for name in REFLECTANCES}
    depth = jnp.where(shown, camera.project(points)[1], jnp.inf)
    return GBuffer(points, made.shader, depth=depth, roughness=made.roughness, **fields)


@eqx.filter_jit
def relit(stage: Stage, gbuffer, camera, light, cast: Shadow) -> Float[Array, "h w 3"]:
    """The picture under the key light and its shadow, and the ambient light."""
    visible = fit.MovingShadow(
        cast.depth, cast.camera, gbuffer, camera, softness=stage.softness, size=5
    )(light)
    key = relight.shade(gbuffer, camera, light, visible)
    return key + relight.shade(gbuffer, camera, AmbientLight(AMBIENT))


@eqx.filter_jit
def blurred(stage: Stage, image, depth, lens: ThinLens) -> Float[Array, "h w 3"]:
    return dof.scatter(image, depth, lens, max_coc=stage.max_coc)


def picture(unknowns: Unknowns, stage: Stage, cast: Shadow) -> Float[Array, "h w 3"]:
    """Everything, from the parameters to the picture."""
    camera = stage.camera(unknowns)
    gbuffer = new_view(stage, camera)
    image = relit(stage, gbuffer, camera, stage.light(unknowns), cast)
    return blurred(stage, image, gbuffer.depth, stage.lens(unknowns))


def floats(tree: Any) -> Any:
    """All floats in JAX's default type: the host gives float32."""
    is_float = lambda x: eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating)
    return jax.tree.map(lambda x: x.astype(float) if is_float(x) else x, tree)


class Mesh(NamedTuple):
    """The host's side: a mesh and the ball about what is seen of it."""

    mesh: Any
    centre: np.ndarray
    radius: float
    map_size: int

    def cast(self, light: DirectionalLight) -> Shadow:
        (camera,) = shadow.light_cameras(
            light, map_size=self.map_size, centre=self.centre, radius=self.radius
        )
        side = self.map_size
        return floats(Shadow(scene.depth(self.mesh, camera, height=side, width=side), camera))


def set_stage(path: Path | None, height: int, map_size: int) -> tuple[Mesh, Stage, Unknowns]:
    """The mesh, its frame buffers, and the parameters to find; a bad file ends the program."""
    width = 4 * height // 3
    try:
        mesh = scene.still_life() if path is None else scene.load(path)
        base = scene.default_camera(mesh, height=height, width=width)
        render = lambda camera, fine=1: scene.gbuffer(
            mesh, camera, height=fine * height, width=fine * width
        )
        base, middle = floats((base, render(base)))
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)
    seen = np.isfinite(middle.depth)
    distance = float(np.median(middle.depth[seen]))
    move = lambda offset: np.block(
        [[np.eye(3), distance * np.array(offset)[:, None]], [0, 0, 0, 1]]
    )
    # The caches see more than the picture, which may turn.
    wide = base.intrinsics.at[(0, 1), (0, 1)].divide(WIDER).at[:2].multiply(FINER)
    cameras = [PinholeCamera(wide, base.world_from_camera @ move(offset)) for offset in CACHES]
    points = base.unproject(pixel_centers(height, width), jnp.where(seen, middle.depth, 1))
    points = np.asarray(points)[seen]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=-1).max())

    lens = ThinLens.from_camera(base, aperture=1.0, focus_distance=FOCUS * distance)
    widest = float(lens.circle_of_confusion(middle.depth[seen]).max())
    stage = Stage(
        [render(camera, FINER) for camera in cameras],
        cameras,
        base,
        base.world_from_camera[:3, :3] @ jnp.array([0.5, 0.6, 0.62]),
        jnp.asarray(distance),
        jnp.asarray(0.02 * radius),
        shape=(height, width),
        max_coc=2 * BLUR * height,
    )
    truth = Unknowns(
        eye=jnp.array(EYE),
        turn=jnp.array(TURN),
        tilt=jnp.array(TILT),
        color=jnp.log(jnp.array(COLOR)),
        aperture=jnp.log(BLUR * height / widest),
        focus=jnp.log(FOCUS * distance),
    )
    return Mesh(mesh, centre, radius, map_size), floats(stage), floats(truth)


def target_of(mesh: Mesh, stage: Stage, truth: Unknowns) -> Float[Array, "h w 3"]:
    """The picture to be met: from the mesh, seen by the true camera itself."""
    camera = stage.camera(truth)
    height, width = stage.shape
    gbuffer = floats(scene.gbuffer(mesh.mesh, camera, height=height, width=width))
    light = stage.light(truth)
    image = relit(stage, gbuffer, camera, light, mesh.cast(light))
    return blurred(stage, image, gbuffer.depth, stage.lens(truth))


def start_of(truth: Unknowns) -> Unknowns:
    """A smaller aperture, another focus, a light from elsewhere, of no colour; no motion.

    What starts blurred may be met by more blur: a local minimum.
    """
    zero = jax.tree.map(jnp.zeros_like, truth)
    return zero._replace(
        aperture=truth.aperture + np.log(0.6), focus=truth.focus + np.log(1.15)
    )


def smoothed(image: Float[Array, "h w 3"], sigma: Float[Array, ""]) -> Float[Array, "h w 3"]:
    """The picture under a Gaussian of so many pixels; round the edges, for residuals may be."""
    down, across = (jnp.fft.fftfreq(n) for n in image.shape[:2])
    squares = (down**2)[:, None] + (across**2)[None]
    low = jnp.exp(-2 * (jnp.pi * sigma) ** 2 * squares)[..., None].astype(complex)
    return jnp.fft.ifft2(low * jnp.fft.fft2(image, axes=(0, 1)), axes=(0, 1)).real


@eqx.filter_jit
def search(unknowns, stage, cast, target, sigma, pull, steps: int):
    """Levenberg-Marquardt; the residual is smoothed by `sigma` pixels, to see what is far.

    What is too smooth to tell a blur would let the lens go anywhere: it is pulled back to where
    the search starts.
    """

    def residual(moved: Unknowns, _):
        away = moved.aperture - unknowns.aperture, moved.focus - unknowns.focus
        difference = smoothed(picture(moved, stage, cast) - target, sigma)
        return difference, pull * jnp.stack(away)

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5)
    found = optx.least_squares(residual, solver, unknowns, max_steps=steps, throw=False)
    return found.value, found.stats["num_steps"]


draw = eqx.filter_jit(picture)


def fitted(mesh: Mesh, stage: Stage, start: Unknowns, target, rounds: int, steps: int):
    """What is found, its last shadow, and the root mean square before and after every round."""
    unknowns, cast = start, mesh.cast(stage.light(start))
    rms = lambda: float(jnp.sqrt(jnp.mean((draw(unknowns, stage, cast) - target) ** 2)))
    errors, count = [rms()], 0
    # From what is far to what is near; a pixel at the last, for textures alias.
    sigmas = np.geomspace(max(target.shape[0] / 24, 1), 1, rounds)[-rounds:]
    for sigma in tqdm(sigmas, "fit", leave=False):
        how = jnp.asarray(sigma), jnp.asarray(0.0 if sigma == sigmas[-1] else PULL)
        unknowns, taken = search(unknowns, stage, cast, target, *how, steps)
        cast = mesh.cast(stage.light(unknowns))
        count += int(taken)
        errors.append(rms())
    return unknowns, cast, errors, count


@eqx.filter_jit
def derivatives(unknowns, stage, cast) -> tuple[Array, Unknowns]:
    """The picture, and its derivative in every unknown: height width 3, of as many as there."""
    twice = lambda unknowns: 2 * (picture(unknowns, stage, cast),)
    jacobian, image = jax.jacfwd(twice, has_aux=True)(unknowns)
    return image, jacobian


def times_of(stage: Stage, unknowns: Unknowns, cast: Shadow) -> tuple[dict, dict]:
    """The median milliseconds of every stage, compiled alone, and what each gives."""
    given: dict[str, Any] = {"camera": stage.camera(unknowns), "lens": stage.lens(unknowns)}
    light = stage.light(unknowns)
    stages: dict[str, Callable[[], Any]] = {
        "new view": lambda: new_view(stage, given["camera"]),
        "light and shadow": lambda: relit(
            stage, given["new view"], given["camera"], light, cast
        ),
        "depth of field": lambda: blurred(
            stage, given["light and shadow"], given["new view"].depth, given["lens"]
        ),
        "picture": lambda: draw(unknowns, stage, cast),
        "13 derivatives": lambda: derivatives(unknowns, stage, cast),
    }
    milliseconds = {}
    for name, call in stages.items():
        given[name] = jax.block_until_ready(call())
        milliseconds[name] = median(call)
    return milliseconds, given


def median(call: Callable[[], Any]) -> float:
    times = []
    for _ in range(CALLS):
        started = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def shown(linear) -> np.ndarray:
    return np.asarray(exr.srgb_from_linear(np.clip(np.asarray(linear), 0, 1)))


def draw_stages(stage: Stage, given: dict, target, path: Path) -> None:
    view, focus = given["new view"], float(given["lens"].focus_distance)
    nearness = 1 / np.maximum(np.asarray(view.depth), 1e-6)
    images = {
        "a frame buffer, from its own camera": shown(stage.caches[-1].diffuse),
        "the new view: reflectance": shown(view.diffuse),
        "the new view: focus / depth": np.clip(nearness * focus / 2, 0, 1),
        "light and shadow": shown(given["light and shadow"]),
        "depth of field": shown(given["depth of field"]),
        "the same from the mesh itself": shown(target),
    }
    panels(images, 3, path)


def draw_derivatives(jacobian: Unknowns, path: Path) -> None:
    """One derivative of each kind, grey where nothing changes."""
    images = {}
    for title, derivative in {
        "eye to the right": jacobian.eye[..., 0],
        "turn about the vertical": jacobian.turn[..., 1],
        "light to the right": jacobian.tilt[..., 0],
        "light, red": jacobian.color[..., 0],
        "aperture": jacobian.aperture,
        "focus distance": jacobian.focus,
    }.items():
        scale = max(float(jnp.percentile(jnp.abs(derivative), 99)), 1e-12)
        images[title] = np.clip(0.5 + np.asarray(derivative) / (2 * scale), 0, 1)
    panels(images, 3, path)


def draw_fit(pictures: dict[str, Any], target, path: Path) -> None:
    images = {title: shown(image) for title, image in pictures.items()}
    for title, image in pictures.items():
        if image is not target:
            difference = np.asarray(image) - np.asarray(target)
            images[f"{title}, less the target"] = np.clip(0.5 + difference, 0, 1)
    panels(images, 3, path)


def panels(images: dict[str, np.ndarray], columns: int, path: Path) -> None:
    rows = -(-len(images) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.4 * columns, 3.6 * rows), layout="constrained"
    )
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, image) in zip(axes.flat, images.items(), strict=False):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title, fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90)
    plt.close(figure)
    write_whole(path, buffer.getvalue())


def plain(unknowns: Unknowns, stage: Stage) -> dict[str, Any]:
    """The parameters in their own units, as numbers."""
    light, lens = stage.light(unknowns), stage.lens(unknowns)
    values = {
        "eye": stage.distance * unknowns.eye,
        "turn": unknowns.turn,
        "light direction": light.direction / jnp.linalg.norm(light.direction),
        "light color": light.color,
        "aperture": lens.aperture,
        "focus distance": lens.focus_distance,
    }
    return {name: np.asarray(value).round(5).tolist() for name, value in values.items()}


def main() -> None:
    arguments = parse()
    logging.basicConfig(format="%(message)s")
    logging.getLogger("jaxfx").setLevel(logging.INFO)
    out = make_folder(arguments.out)
    mesh, stage, truth = set_stage(arguments.scene, arguments.height, arguments.map_size)
    target = target_of(mesh, stage, truth)
    milliseconds, given = times_of(stage, truth, mesh.cast(stage.light(truth)))
    for name, time_taken in milliseconds.items():
        print(f"{name:18}{time_taken:9.1f} ms", flush=True)
    draw_stages(stage, given, target, out / "stages.png")
    draw_derivatives(given["13 derivatives"][1], out / "derivatives.png")

    start = start_of(truth)
    first = draw(start, stage, mesh.cast(stage.light(start)))
    counts = arguments.rounds, arguments.steps
    found, cast, errors, steps = fitted(mesh, stage, start, target, *counts)
    fit_picture = draw(found, stage, cast)
    draw_fit({"target": target, "start": first, "found": fit_picture}, target, out / "fit.png")
    floor = float(jnp.sqrt(jnp.mean((given["picture"] - target) ** 2)))
    values = {"truth": truth, "start": start, "found": found}
    report = {
        "height": arguments.height,
        "cores": os.cpu_count(),
        "milliseconds": milliseconds,
        "parameters": {name: plain(value, stage) for name, value in values.items()},
        "rms": {"start": errors[0], "rounds": errors[1:], "true parameters": floor},
        "steps": steps,
    }
    write_whole(out / "report.json", json.dumps(report, indent=2).encode())
    print(f"\n{'':16}{'truth':>26}{'start':>26}{'found':>26}")
    for name in report["parameters"]["truth"]:
        line = (report["parameters"][column][name] for column in values)
        print(f"{name:16}" + "".join(f"{words(value):>26}" for value in line))
    print(f"rms {errors[0]:.4f} -> {errors[-1]:.4f}, {floor:.4f} with the true parameters")
    print(f"pictures and report in {out}")


def words(value) -> str:
    return " ".join(f"{number:.4f}" for number in np.atleast_1d(value))


if __name__ == "__main__":
    main()
