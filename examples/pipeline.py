"""From a mesh to an image through every effect, and from an image back to its parameters.

A mesh is rendered into G-buffers by a few cameras. Then one compiled function draws an image
from them: the G-buffer of a new camera (`reproject.blend`, `relight.fill_holes`), a key light
with its shadow, and depth of field (`dof.scatter`). It is differentiated end to end in 13
numbers: the camera's position and rotation, the key light's direction and color, the lens'
aperture and focus distance. Levenberg-Marquardt finds all of them from a noisy image that the
same function drew. From an image of the mesh itself (`--of-mesh`), which is sharper than one
interpolated between the pixels of G-buffers, it finds camera and light, but not the lens.
Prints the time of every stage, the errors that are left, and those that noise alone would
leave; writes `stages.png`, `derivatives.png`, `fit.png` and `report.json`.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import _pipeline
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _begin import fail, make_folder
from jaxtyping import Array, Float

from jaxfx import dof, relight, reproject, scene, shadow
from jaxfx._files import write_whole
from jaxfx.camera import PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.lens import ThinLens
from jaxfx.light import AmbientLight, DirectionalLight


# Where the cameras of the G-buffers stand, from the scene's camera: right, down and forward, as
# ratios to the median depth; and how many times as wide their images are.
CACHES = ((0.0, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.12, -0.05, 0.0))
WIDER = 1.3
AMBIENT = (0.2, 0.21, 0.24)
# The largest circle of confusion of the target, as a ratio to the image's height.
BLUR = 0.08
# The depth of holes, in median depths; and the step in depth between pixels, as a ratio to the
# depth, from which on there is an edge.
FAR, JUMP = 1e4, 0.05
# The rounds of a search: the sigma of the residual's blur, as a ratio to the height, but no
# less than a pixel; and how many numbers are sought: the lens last, which blurred images show
# least.
ROUNDS = ((1 / 12, 11), (1 / 24, 11), (1 / 48, 13), (0.0, 13), (0.0, 13), (0.0, 13))
# Lenses that are compared before the lens is sought: changes of the logarithms of both numbers.
LENSES = [(a, n) for a in np.linspace(-0.5, 0.5, 5) for n in np.linspace(-0.36, 0.36, 7)]

# The 13 numbers of the target, and by how much each start is off, up or down:
# - the camera's motion as a twist about its own axes, in median depths and in radians;
# - the tilt of the light's direction to the right and down, as slopes, and its log color;
# - the log of the lens' aperture, here that of BLUR, and the distance over the focus distance.
NAMES = ("eye x", "eye y", "eye z", "turn x", "turn y", "turn z", "light x", "light y")
NAMES += ("red", "green", "blue", "aperture", "nearness of focus")
TRUTH = np.array([12, -8, 15, 7, -9, 6, 120, -100, 0, -80, -220, 0, 1540]) / 1000
OFF = np.array([15, 15, 15, 10, 10, 10, 120, 120, 200, 200, 200, 400, 250]) / 1000
# A shadow map, and the camera at the light that it was made with.
Shadow = tuple[Float[Array, "rows columns"], Any]
Numbers = Float[Array, "13"]
Image = Float[Array, "height width 3"]


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--scene", type=Path, help="a mesh; without it, a still life")
    add("--height", type=int, default=120, help="of the image, pixels; 4 : 3 wide")
    add("--map-size", type=int, default=256, help="side of the shadow map, texels")
    add("--starts", type=int, default=1, help="searches, each from another start")
    add("--steps", type=int, default=10, help="of Levenberg-Marquardt, in each of 6 rounds")
    add("--seed", type=int, default=0, help="of the first start and of the target's noise")
    add("--of-mesh", action="store_true", help="the target is an image of the mesh itself")
    add("--noise", type=float, default=0.01, help="of the target, its standard deviation")
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    least = {"height": 24, "map_size": 16, "starts": 1, "steps": 1, "seed": 0, "noise": 0}
    return _pipeline.parsed(parser, least)


class Stage(eqx.Module):
    """All that the image depends on beside its 13 numbers.

    - `distance`: the median depth, in scene units.
    - `softness`: that of the shadow, in scene units.
    """

    caches: list[GBuffer]
    cameras: list[PinholeCamera]
    base: PinholeCamera
    direction: Float[Array, "3"]
    distance: Float[Array, ""]
    softness: Float[Array, ""]
    shape: tuple[int, int] = eqx.field(static=True)
    max_coc: float = eqx.field(static=True)

    def camera(self, numbers: Numbers) -> PinholeCamera:
        turn = jnp.cross(jnp.eye(3), numbers[None, 3:6])
        twist = jnp.c_[turn, self.distance * numbers[:3]]
        twist = jax.scipy.linalg.expm(jnp.pad(twist, ((0, 1), (0, 0))))
        pose = self.base.world_from_camera @ twist
        return PinholeCamera(self.base.intrinsics, pose)

    def light(self, numbers: Numbers) -> DirectionalLight:
        tilt = self.base.world_from_camera[:3, :2] @ numbers[6:8]
        return DirectionalLight(self.direction + tilt, jnp.exp(numbers[8:11]))

    def lens(self, numbers: Numbers) -> ThinLens:
        aperture, focus = jnp.exp(numbers[11]), self.distance / numbers[12]
        return ThinLens.from_camera(self.base, aperture=aperture, focus_distance=focus)


@eqx.filter_jit
def new_view(stage: Stage, camera: PinholeCamera) -> GBuffer:
    """The G-buffer of another camera, from the caches: every channel is reprojected.

    In place of a color, which is not shaded, go the points of the world: they give the depth.
    """
    here = jax.lax.stop_gradient(camera)
    images = [channels(*pair) for pair in zip(stage.caches, stage.cameras, strict=True)]
    depths = [cache.depth for cache in stage.caches]
    image, alpha = reproject.blend(
        images, depths, stage.cameras, here, height=stage.shape[0], width=stage.shape[1]
    )
    points, ambient, diffuse, specular, normal, kinds = (
        image[..., first : first + 3] for first in range(0, 18, 3)
    )
    shader = jnp.where(jnp.sum(kinds, axis=-1) > 0.5, jnp.argmax(kinds, axis=-1), -1)
    # A hole lies beyond everything until it is filled with its neighbor.
    depth = jnp.where(alpha > 0, here.project(points)[1], FAR * stage.distance)
    surface = ambient, diffuse, specular, normal  # Shading makes them unit vectors.
    made = GBuffer(points, shader, *surface, depth=depth, roughness=image[..., 18])
    made, _ = relight.fill_holes(made, (alpha > 0).astype(int))
    return moving(made, camera)


def channels(cache: GBuffer, camera: PinholeCamera) -> Float[Array, "height width 19"]:
    """Points of the world and all that shading reads, with a channel for each shader."""
    depth = jnp.where(jnp.isfinite(cache.depth), cache.depth, 1)
    points = camera.points(depth)
    kinds = jax.nn.one_hot(cache.shader, 3, dtype=depth.dtype)
    surface = cache.ambient, cache.diffuse, cache.specular, cache.normal
    return jnp.dstack([points, *surface, kinds, cache.roughness])


def moving(made: GBuffer, camera: PinholeCamera) -> GBuffer:
    """The same G-buffer, with a derivative in the camera.

    Each pixel moves with the point that it shows, by the slopes of the image (Lucas & Kanade
    1981). `blend` itself has the derivative of where its rays hit, in which the few that graze
    a surface outweigh all others. Missing here: what comes into sight, and the motion of points
    at steps in depth.
    """
    points = made.color
    pixels, depth = camera.project(points)
    step = jax.lax.stop_gradient(pixels) - pixels  # 0, with a derivative

    def moved(image, counts: Any = 1.0):
        down, across = jnp.gradient(image, axis=(0, 1))
        return image + counts * (across * step[..., :1] + down * step[..., 1:])

    down, across = jnp.gradient(jax.lax.stop_gradient(depth))
    smooth = jnp.maximum(jnp.abs(down), jnp.abs(across)) < JUMP * depth
    points = moved(points, smooth[..., None].astype(depth.dtype))
    depth = jnp.where(made.shader >= 0, camera.project(points)[1], jnp.inf)
    surface = map(moved, (made.ambient, made.diffuse, made.specular, made.normal))
    return GBuffer(points, made.shader, *surface, depth=depth, roughness=made.roughness)


@eqx.filter_jit
def relit(stage: Stage, gbuffer, camera, light: DirectionalLight, cast: Shadow) -> Image:
    """The image under the key light with its shadow, and the ambient light."""
    softness = stage.softness
    visible = shadow.MovingShadow(*cast, gbuffer, camera, softness=softness, size=5)(light)
    key = relight.shade(gbuffer, camera, light, visible)
    return key + relight.shade(gbuffer, camera, AmbientLight(AMBIENT))


@eqx.filter_jit
def blurred(stage: Stage, image, depth, lens: ThinLens) -> Image:
    return dof.scatter(image, depth, lens, max_coc=stage.max_coc)


def whole_image(numbers: Numbers, stage: Stage, cast: Shadow) -> Image:
    """The whole pipeline, from the parameters to the image."""
    camera = stage.camera(numbers)
    gbuffer = new_view(stage, camera)
    image = relit(stage, gbuffer, camera, stage.light(numbers), cast)
    return blurred(stage, image, gbuffer.depth, stage.lens(numbers))


draw = eqx.filter_jit(whole_image)


def residual(numbers: Numbers, stage: Stage, cast: Shadow, target, sigma) -> Image:
    """The image less the target, blurred by a Gaussian of `sigma` pixels that wraps around."""
    down, across = (jnp.fft.fftfreq(n)[:, None] for n in stage.shape)
    low = jnp.exp(-2 * (jnp.pi * sigma) ** 2 * (down**2 + (across**2).T))
    difference = jnp.fft.fft2(whole_image(numbers, stage, cast) - target, axes=(0, 1))
    return jnp.fft.ifft2(low[..., None].astype(complex) * difference, axes=(0, 1)).real


@eqx.filter_jit
def forward(numbers: Numbers, *rest) -> tuple[Image, Float[Array, "height width 3 13"]]:
    """The residual and its derivative in every number."""
    twice = lambda numbers: 2 * (residual(numbers, *rest),)
    jacobian, image = jax.jacfwd(twice, has_aux=True)(numbers)
    return image, jacobian


@eqx.filter_jit
def reverse(numbers: Numbers, *rest) -> Numbers:
    """The derivative of the residual's mean square in every number."""
    return jax.grad(lambda numbers: jnp.mean(residual(numbers, *rest) ** 2))(numbers)


class Mesh(NamedTuple):
    """A mesh, rendered on the host, and the ball about its visible part."""

    mesh: Any
    centre: np.ndarray
    radius: float
    map_size: int

    def gbuffer(self, camera: PinholeCamera, shape: tuple[int, int]) -> GBuffer:
        return floats(scene.gbuffer(self.mesh, camera, height=shape[0], width=shape[1]))

    def cast(self, light: DirectionalLight) -> Shadow:
        side, ball = self.map_size, {"scene_center": self.centre, "scene_radius": self.radius}
        (camera,) = shadow.light_cameras(light, map_size=side, **ball)
        return floats((scene.depth(self.mesh, camera, height=side, width=side), camera))


def floats(tree: Any) -> Any:
    """All floats in JAX's default type: the host gives float32."""
    is_float = lambda x: eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating)
    return jax.tree.map(lambda x: x.astype(float) if is_float(x) else x, tree)


def set_stage(path: Path | None, height: int, map_size: int) -> tuple[Mesh, Stage, np.ndarray]:
    """The mesh, its G-buffers, and the numbers to find; a bad file ends the program."""
    shape = height, 4 * height // 3
    try:
        loaded = scene.still_life() if path is None else scene.load(path)
        base = floats(scene.default_camera(loaded, height=shape[0], width=shape[1]))
        middle = Mesh(loaded, np.zeros(3), 1.0, map_size).gbuffer(base, shape)
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)
    seen = np.isfinite(middle.depth)
    distance = float(np.median(middle.depth[seen]))
    points = np.asarray(base.points(jnp.where(seen, middle.depth, 1)))[seen]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=-1).max())
    mesh = Mesh(loaded, centre, radius, map_size)
    wide, axes = base.intrinsics.at[:2, 2].multiply(WIDER), base.world_from_camera[:3, :3]
    cameras = [
        PinholeCamera(wide, base.world_from_camera.at[:3, 3].add(distance * axes @ move))
        for move in jnp.array(CACHES)
    ]
    rows, columns = (round(WIDER * side) for side in shape)
    caches = [mesh.gbuffer(camera, (rows, columns)) for camera in cameras]
    direction = axes @ jnp.array([0.5, 0.6, 0.62])
    lengths = jnp.asarray(distance), jnp.asarray(0.02 * radius)
    stage = floats(
        Stage(caches, cameras, base, direction, *lengths, shape, max_coc=3 * BLUR * height)
    )
    widest = stage.lens(jnp.asarray(TRUTH)).circle_of_confusion(middle.depth[seen]).max()
    truth = TRUTH + np.log(BLUR * height / float(widest)) * (np.arange(13) == 11)
    return mesh, stage, truth


def search(mesh: Mesh, stage: Stage, start: np.ndarray, target: Image, steps: int):
    """The numbers found from coarse to fine, figures of the search, covariance of errors."""
    begun, numbers, count, loss, squares = time.perf_counter(), start, 0, 0.0, np.eye(13)
    for index, (share, free) in enumerate(ROUNDS):
        sigma = jnp.asarray(max(share * stage.shape[0], 1.0))
        rest = stage, mesh.cast(stage.light(jnp.asarray(numbers, float)))
        if free > ROUNDS[index - 1][1]:
            numbers = best_lens(numbers, target, *rest)
        model = lambda each, rest=(*rest, target, sigma): _pipeline.equations(
            *forward(jnp.asarray(each, float), *rest)
        )
        numbers, loss, squares, taken = _pipeline.descend(model, numbers, free, steps)
        count += taken
    went = {"rms": np.sqrt(loss), "steps": count, "seconds": time.perf_counter() - begun}
    return numbers, went, np.linalg.pinv(squares, hermitian=True) * loss / target.size


def best_lens(numbers: np.ndarray, target: Image, *rest) -> np.ndarray:
    """The numbers with the best lens of `LENSES`: there may be a minimum on either side."""
    changes = (np.r_[np.zeros(11), a, numbers[12] * np.expm1(n)] for a, n in LENSES)
    tried = [numbers + change for change in changes]
    images = (draw(jnp.asarray(point, float), *rest) for point in tried)
    return tried[np.argmin([float(jnp.mean((image - target) ** 2)) for image in images])]


def expected(covariance: np.ndarray) -> tuple[np.ndarray, str]:
    """The standard errors, and the two numbers that the image tells apart worst."""
    deviations = np.sqrt(np.diag(covariance))
    alike = np.abs(np.triu(covariance / np.outer(deviations, deviations), 1))
    one, other = np.unravel_index(np.argmax(alike), alike.shape)
    return deviations, f"{NAMES[one]} and {NAMES[other]}, correlation {alike.max():.2f}"


def sizes(away: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """The sizes of errors, in degrees and per cent."""
    percent = lambda logs: 100 * np.expm1(np.max(np.abs(logs)))
    values = {
        "eye, % of the distance": 100 * np.linalg.norm(away[:3]),
        "turn, degrees": np.degrees(np.linalg.norm(away[3:6])),
        "light, degrees": np.degrees(np.linalg.norm(away[6:8])),
        "light's color, %": percent(away[8:11]),
        "aperture, %": percent(away[11]),
        "focus distance, %": 100 * abs(truth[12] / (truth[12] + away[12]) - 1),
    }
    return {name: float(value) for name, value in values.items()}


def times_of(numbers: Numbers, stage: Stage, cast: Shadow, target: Image) -> tuple[dict, dict]:
    """Median milliseconds of every stage, compiled alone, and the result of each."""
    given: dict[str, Any] = {}
    camera, light, lens = stage.camera(numbers), stage.light(numbers), stage.lens(numbers)
    rest = stage, cast, target, jnp.asarray(0.0)
    stages: dict[str, Callable[[], Any]] = {
        "new view": lambda: new_view(stage, camera),
        "light and shadow": lambda: relit(stage, given["new view"], camera, light, cast),
        "depth of field": lambda: blurred(
            stage, given["light and shadow"], given["new view"].depth, lens
        ),
        "whole image": lambda: draw(numbers, stage, cast),
        "13 derivatives, forward": lambda: forward(numbers, *rest),
        "gradient, reverse": lambda: reverse(numbers, *rest),
    }
    return {name: _pipeline.timed(name, call, given) for name, call in stages.items()}, given


def main() -> None:
    arguments = parse()
    out, seed, steps = make_folder(arguments.out), arguments.seed, arguments.steps
    mesh, stage, truth = set_stage(arguments.scene, arguments.height, arguments.map_size)
    numbers = jnp.asarray(truth, float)
    camera, light, lens = stage.camera(numbers), stage.light(numbers), stage.lens(numbers)
    # From the mesh itself: the image of caches that miss nothing.
    cast, seen = mesh.cast(light), mesh.gbuffer(camera, stage.shape)
    from_mesh = blurred(stage, relit(stage, seen, camera, light, cast), seen.depth, lens)
    milliseconds, given = times_of(numbers, stage, cast, from_mesh)
    view, (image, jacobian) = given["new view"], given["13 derivatives, forward"]
    images = {
        "a frame buffer, from its own camera": _pipeline.shown(stage.caches[-1].diffuse),
        "the new view: reflectance": _pipeline.shown(view.diffuse),
        "the new view: focus / depth": np.clip(lens.focus_distance / view.depth / 2, 0, 1),
        "light and shadow": _pipeline.shown(given["light and shadow"]),
        "depth of field": _pipeline.shown(given["depth of field"]),
        "the same from the mesh itself": _pipeline.shown(from_mesh),
    }
    _pipeline.write_panels(out / "stages.png", images)
    images = {NAMES[i]: _pipeline.gray(jacobian[..., i]) for i in (0, 4, 6, 8, 11, 12)}
    _pipeline.write_panels(out / "derivatives.png", images)

    noise = np.random.default_rng(seed).normal(0, arguments.noise, image.shape)
    target = (from_mesh if arguments.of_mesh else given["whole image"]) + jnp.asarray(
        noise, float
    )
    starts, found = {}, {}
    for index in range(arguments.starts):
        signs = np.random.default_rng(seed + index).choice([-1, 1], 13)
        starts[index] = truth + signs * OFF
        found[f"found {index}"] = search(mesh, stage, starts[index], target, steps)
    values, _, covariance = found["found 0"]
    ends = (jnp.asarray(each, float) for each in (starts[0], values))
    first, last = (draw(each, stage, mesh.cast(stage.light(each))) for each in ends)
    images = {"target": target, "start": first, "found": last}
    images = {name: _pipeline.shown(image) for name, image in images.items()}
    images["start, less the target"] = _pipeline.gray(first - target, 1.0)
    images["found, less the target, 5 times"] = _pipeline.gray(last - target, 0.2)
    _pipeline.write_panels(out / "fit.png", images)
    errors = {"start": sizes(starts[0] - truth, truth)}
    errors |= {name: sizes(values - truth, truth) for name, (values, *_) in found.items()}
    deviations, hardest = expected(covariance)
    errors["if noise"] = sizes(deviations, truth)
    slope = 2 * _pipeline.equations(image, jacobian)[1]
    apart = np.max(np.abs(given["gradient, reverse"] - slope)) / np.max(np.abs(slope))
    report = {
        "height": arguments.height,
        "cores": os.cpu_count(),
        "milliseconds": milliseconds,
        "reverse less forward": float(apart),
        "errors": errors,
        "searches": {name: went for name, (_, went, _) in found.items()},
        "hardest to tell apart": hardest,
    }
    write_whole(out / "report.json", json.dumps(report, indent=2).encode())
    _pipeline.print_table(errors)
    for name, went in report["searches"].items():
        print(name + ", ".join(f" {key} {value:.3g}" for key, value in went.items()))
    print(f"hardest to tell apart: {hardest}\n{_pipeline.IF_NOISE}")
    print(f"images and report in {out}")


if __name__ == "__main__":
    main()
