"""Where relighting fails: models at their limits, long edits, new views, blends, bad caches."""

import functools as ft
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import (
    GBuffer,
    PinholeCamera,
    PointLight,
    exr,
    relight,
    scene,
)
from tests.cases.registry import Found, case, not_measured
from tests.cases.relight_views import (
    BLUE,
    BY_HAND,
    CAMERAS,
    DEGENERATE,
    FRONT,
    FRONTAL,
    RED,
    REFLECTANCES,
    TARGET,
    cache,
    orbit,
    plane,
    points,
)


@case(
    "relight",
    {"error": 1e-12},
    BY_HAND,
    dict.fromkeys(("Phong", "Blinn"), "exact; missing: a highlight that N.L = 0 cuts off")
    | {"background": "zero: it is black"},
)
def closed_form_pixels(method):
    """Pixels made by hand, of each model under each light: the largest relative error, absolute
    where the pixel is black."""
    found = []
    for gbuffer, light, share in BY_HAND[method]:
        image = np.asarray(relight.shade(gbuffer, FRONT, light))[0, 0]
        found.append((image, share * np.array([4, 8, 12])))
    shown, expected = map(np.array, zip(*found, strict=True))
    scale = np.where(expected == 0, 1, expected)
    worst = float(np.abs((shown - expected) / scale).max())
    return Found({"error": worst}, np.resize(shown / 12, (3, 3, 3)))


@case(
    "relight",
    {"rms": 0.0125, "wrong pixels": 0.01},
    ("no shadows", "shadows"),
    "exact, of light; missing: of visibility, which is given",
    needs="mitsuba",
)
def path_tracer(method):
    """Direct light on the still life, every surface Lambert, against Mitsuba's: rms error over
    the brightest pixel, and the share of pixels off by more than 1e-4, whose centre lies on an
    edge."""
    from benchmarks.scenes import relight_truth as truth

    size, lights = (48, 64), [*truth.LIGHTS.values()]
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=size[0], width=size[1])
    gbuffer, shadows = truth.lambert(mesh, camera, size), method == "shadows"
    visible = None
    if shadows:
        position = points(camera, gbuffer.depth.astype(float))
        visible = [truth.unshadowed(mesh, position, light) for light in lights]
    image = relight.start(gbuffer, camera, lights, visibilities=visible).image
    each = [truth.direct(mesh, camera, light, size, shadows=shadows) for light in lights]
    expected = np.sum(each, axis=0)
    error = (np.asarray(image) - expected) / expected.max()
    wrong = np.mean(np.abs(error).max(axis=-1) > 1e-4)
    figures = {"rms": float(np.sqrt(np.mean(error**2))), "wrong pixels": float(wrong)}
    return Found(figures, image)


# Edits.


@ft.cache
def _small() -> tuple[GBuffer, PinholeCamera, list[PointLight]]:
    """Surfaces of every model that more or less face a camera, in float32, and three lights."""
    rng, size = np.random.default_rng(0), (7, 9)
    normal = rng.normal((0, 0, -1), 0.4, (*size, 3))
    shader = rng.permutation(63).reshape(size) % 4 - 1
    images = {name: rng.uniform(0.1, 1, (*size, 3)) for name in REFLECTANCES} | {
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "depth": np.where(shader == -1, np.inf, rng.uniform(1.5, 4, size)),
        "roughness": rng.uniform(0.3, 0.9, size),
    }
    single = {name: image.astype(np.float32) for name, image in images.items()}
    rows = rng.uniform((-1, 0.5), (1, 2), (3, 3, 2)).astype(np.float32)
    lights = [PointLight(row[:, 0], row[:, 1]) for row in rows]
    camera = PinholeCamera.from_fov(0.9, height=7, width=9)
    return GBuffer(shader=shader, **single), camera, lights


@ft.cache
def _work(count: int) -> np.ndarray:
    """The operations and the bytes of the compiled edit of one of so many lights."""
    gbuffer, camera, lights = _small()
    state = eqx.tree_at(
        lambda s: (s.lights, s.visibilities),
        relight.start(gbuffer, camera, lights[:1]),
        (tuple(lights[:1]) * count, (None,) * count),
    )
    edit = jax.jit(lambda state, light: state.edit(0, light).image)
    cost = edit.lower(state, lights[0]).compile().cost_analysis()
    return np.array([cost["flops"], cost["bytes accessed"]])


@jax.jit
def _edited(state: Any, lights: Any, rounds: Any) -> Any:
    """Six edits a round: the worst chain, so that what is lost is lost each time."""
    one, two, three = lights

    def step(_, state):
        for i in (0, 1):
            for light in (two, one, three):
                state = state.edit(i, light)
        return state

    return jax.lax.fori_loop(0, rounds, step, state)


EDITS = {f"{count} lights, {10 * count} edits": count for count in (10, 100, 1000)}


@case("relight", {"work": 0.01, "drift": 1e-5}, EDITS)
def edit_one_light(method):
    """The operations and bytes of the compiled edit of one light of so many, over those of the
    only one, less 1 (times: benchmarks/test_relight_speed.py). The largest error, of the
    image's range, after so many edits of the same two lights in turn, in float32."""
    count, (gbuffer, camera, lights) = EDITS[method], _small()
    start = relight.start(gbuffer, camera, [lights[2], lights[2], lights[1]])
    state = _edited(start, lights, jnp.asarray(10 * count // 6))
    fresh = relight.render(gbuffer, camera, state.lights)
    drift = float(jnp.max(jnp.abs(state.image - fresh)) / jnp.max(fresh))
    work = float(np.abs(_work(count) / _work(1) - 1).max())
    return Found({"work": work, "drift": drift}, state.image / jnp.max(fresh))


# New views.

LARGE = (72, 96)
AROUND = [(-6, 0.0), (6, 0.0), (0, 0.25), (0, -0.2)]
AROUND += [(-14, 0.1), (14, 0.1), (-10, 0.4), (10, 0.4)]
VIEWS = {
    f"{count} cache{'s' * (count > 1)}, {degrees} degrees": (count, degrees)
    for degrees in (5, 30)
    for count in (1, 2, 4, 8)
}
NEAREST = "zero along the image, of a nearest read; missing: of what is visible, and of holes"


@ft.cache
def _around() -> tuple[list[GBuffer], list[PinholeCamera]]:
    cameras = [orbit(*where, size=LARGE) for where in AROUND]
    return [cache(camera, LARGE) for camera in cameras], cameras


@ft.cache
def _view(degrees: int) -> tuple[Any, ...]:
    """The target, its own cache, and the image of that."""
    target = orbit(degrees, 0.1, LARGE)
    truth = cache(target, LARGE)
    return target, truth, relight.render(truth, target, scene.default_lights(target))


def _rms(one: Any, other: Any, mask: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(one) - np.asarray(other))[mask] ** 2)))


@case(
    "relight",
    {"parameters": 0.126, "picture": 0.1, "holes": 0.2, "picture in holes": None, "ids": 0.005},
    VIEWS,
    NEAREST,
    needs="embreex",
)
def new_view(method):
    """The still life's cache, put together from 1 to 8 others up to 14 degrees away, against
    one rendered again: the worst rms error of colour, diffuse, specular, roughness and normal
    where any cache sees, and that of the relit image; the share of holes; the image's
    error in them once they are filled; and the share of wrong shaders."""
    count, degrees = VIEWS[method]
    gbuffers, cameras = (each[:count] for each in _around())
    target, truth, expected = _view(degrees)
    found, views = relight.synthesize(gbuffers, cameras, target, depth=truth.depth)
    shown, seen = np.asarray(truth.shader) >= 0, np.asarray(views) > 0
    filled, _ = relight.fill_holes(found, views)
    image = relight.render(filled, target, scene.default_lights(target))
    names = ("color", "diffuse", "specular", "roughness", "normal")
    holes = shown & ~seen
    figures = {
        "parameters": max(_rms(getattr(found, n), getattr(truth, n), seen) for n in names),
        "picture": _rms(image, expected, seen),
        "holes": float(holes.sum() / shown.sum()),
        "picture in holes": _rms(image, expected, holes) if holes.any() else 0.0,
        "ids": float(np.mean(np.asarray(found.shader != truth.shader)[seen])),
    }
    return Found(figures, np.where(holes[..., None], np.nan, np.asarray(image)))


# Two surfaces that must not blend: the second, beside the first, and where its edge is.

SECOND: dict[str, tuple[Any, float]] = {
    "a cliff": (plane([0, 0, -1], offset=1.0), 0.1),
    "0.3 of the tolerance apart": (plane([0, 0, -1], offset=0.0045), 0.1),
    "so, of another shader": (plane([0, 0, -1], offset=0.0045, shader=2), 0.1),
    "another normal": (plane([0.7, 0, -1]), 0.0),
}


def split_view(one: Any, other: Any, camera: PinholeCamera, edge: float) -> GBuffer:
    """A cache that shows one plane left of the world's `x = edge` on it, the other right."""
    left, right = one(camera, RED), other(camera, BLUE)
    x = points(camera, left.depth)[..., 0]
    choose = lambda a, b: np.where((x < edge).reshape(x.shape + (1,) * (a.ndim - 2)), a, b)
    return jax.tree.map(choose, left, right)


@case(
    "relight",
    {"blend": 1e-6, "wrong": 0.034, "not covered": 0.1},
    (*SECOND, "a sheet from both sides"),
    "exact, of the colours; missing: of the choice of a surface",
)
def close_surfaces(method):
    """A red and a blue surface, side by side, or one behind the other with mirrored normals,
    from three caches: the largest distance of a colour from the nearer pure one; the share of
    pixels of the wrong one, at most one pixel a row along the edge; and of those left out."""
    if method == "a sheet from both sides":
        look = PinholeCamera.look_at
        behind = look([0, 0, 6], [0, 0, 3], up=[0, -1, 0], fov_y=0.7, height=24, width=32)
        gbuffers = [FRONTAL(CAMERAS[0], color=RED), FRONTAL(behind, color=BLUE)]
        cameras, truth = [CAMERAS[0], behind], FRONTAL(TARGET, color=RED)
    else:
        other, edge = SECOND[method]
        cameras, truth = CAMERAS, split_view(FRONTAL, other, TARGET, edge)
        gbuffers = [split_view(FRONTAL, other, camera, edge) for camera in cameras]
    options = {"depth": truth.depth, "tolerance": 0.005}
    found, views = relight.synthesize(gbuffers, cameras, TARGET, **options)
    color, covered = np.asarray(found.color), np.asarray(views) > 0
    apart = [np.abs(color - pure).max(axis=-1)[covered] for pure in (RED, BLUE)]
    wrong = np.abs(color - np.asarray(truth.color)).max(axis=-1)[covered] > 1e-6
    seen = pinhole_sees(truth, cameras[0]) if len(cameras) == 2 else np.ones((24, 32), bool)
    figures = {
        "blend": float(np.minimum(*apart).max()),
        "wrong": float(wrong.mean()),
        "not covered": float((seen & ~covered).mean()),
    }
    return Found(figures, np.where(covered[..., None], color, np.nan))


def pinhole_sees(truth: GBuffer, camera: PinholeCamera) -> np.ndarray:
    """Which of the target's points lie in a camera's image."""
    pixels = np.asarray(camera.project(jnp.asarray(points(TARGET, truth.depth)))[0])
    return ((pixels >= 0) & (pixels < (32, 24))).all(axis=-1)


# Antialiased caches.

FINE = 4


def shrunk(image: Any) -> jax.Array:
    """The means of blocks."""
    rows, columns = (side // FINE for side in image.shape[:2])
    blocks = np.asarray(image).reshape(rows, FINE, columns, FINE, *image.shape[2:])
    return jnp.asarray(blocks.mean(axis=(1, 3)))


def averaged(gbuffer: GBuffer) -> GBuffer:
    """One cache of the means of blocks, as an antialiasing renderer would write it."""
    names = ("color", "ambient", "diffuse", "specular", "normal", "depth", "roughness")
    far = jnp.where(jnp.isfinite(gbuffer.depth), gbuffer.depth, 20)
    fields = {name: far if name == "depth" else getattr(gbuffer, name) for name in names}
    middle = gbuffer.shader[FINE // 2 :: FINE, FINE // 2 :: FINE]
    return GBuffer(shader=middle, **{name: shrunk(value) for name, value in fields.items()})


@ft.cache
def _antialiased() -> tuple[Any, ...]:
    """The truth, the two wrong images and the pixels on silhouettes."""
    height, width = 24, 32
    size, fine = ({"height": n * height, "width": n * width} for n in (1, FINE))
    mesh = scene.still_life()
    fine_camera, camera = (scene.default_camera(mesh, **each) for each in (fine, size))
    fine_cache = scene.gbuffer(mesh, fine_camera, **fine, backend="embree")
    lights = scene.default_lights(camera)
    truth = shrunk(relight.render(fine_cache, fine_camera, lights))
    once = scene.gbuffer(mesh, camera, **size, backend="embree")
    wrong = relight.render(averaged(fine_cache), camera, lights)
    blocks = np.asarray(scene.object_ids(mesh, fine_camera, **fine))
    blocks = blocks.reshape(height, FINE, width, FINE)
    edge = blocks.max(axis=(1, 3)) != blocks.min(axis=(1, 3))
    plain = relight.render(once, camera, lights)
    return {"average, then shade": wrong, "one sample a pixel": plain}, truth, edge


@case(
    "relight",
    {"rms at silhouettes": 0.01, "rms elsewhere": None},
    ("average, then shade", "one sample a pixel"),
    {"average, then shade": "biased: of a surface that is nowhere"},
    needs="embreex",
)
def antialiased_caches(method):
    """A cache averaged from 4 x 4 finer pixels, and one that is not, against shading these and
    averaging then."""
    pictures, truth, edge = _antialiased()
    image = pictures[method]
    figures = {"at silhouettes": edge, "elsewhere": ~edge}
    return Found({f"rms {k}": _rms(image, truth, mask) for k, mask in figures.items()}, image)


# Bad caches.


@jax.jit
def _value_slope_and_curvature(arguments: Any, shader: Any) -> Any:
    """What a pixel shows, its derivatives, and theirs along one direction."""

    def score(arguments):
        floats, *others = arguments
        return jnp.sum(relight.shade(eqx.combine(floats, shader), *others))

    along = jax.tree.map(lambda leaf: jnp.cos(7 * leaf + 1), arguments)
    along = jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(leaf), leaf, 1), along)
    return jax.jvp(jax.value_and_grad(score), (arguments,), (along,))


DARK_SIDE = "zero: at N.L = 0, R.V = 0 and N.H = 0 that of the dark side"


@case(
    "relight",
    {"not finite": 0.0},
    DEGENERATE,
    {
        "light in the surface's plane": DARK_SIDE,
        "mirror image across the view": DARK_SIDE,
        "light against the view": DARK_SIDE,
        "spot turned away": "zero: it is dark",
        "spot that closes": "zero: it is dark",
        "zero normal": "zero: it is dark",
        "background": "zero: it is black",
        "a surface infinitely far": "zero: it is dark",
    },
)
def degenerate_pixels(method):
    """In float32, of what a pixel shows, its derivatives in all that makes it, and theirs along
    one direction: how many are not finite. (No lights, and what a NaN of a cache spoils, its
    own pixel: tests/relight/test_shading.py.)"""
    gbuffer, light = DEGENERATE[method]
    floats, shader = eqx.partition(gbuffer, eqx.is_inexact_array)
    arguments = jax.tree.map(lambda leaf: leaf.astype(np.float32), (floats, FRONT, light))
    found = jax.tree.leaves(_value_slope_and_curvature(arguments, shader))
    wrong = sum(int((~np.isfinite(leaf)).sum()) for leaf in found)
    return Found({"not finite": float(wrong)}, relight.shade(gbuffer, FRONT, light) / 12)


@case("relight", {"bits": 0.0, "unnoticed": 0.0}, ("float16", "float32"), "none: files")
def exr_files(method):
    """A cache with its camera, out and in: values of which a bit differs; and of 120 copies, of
    which one byte is another or the end is missing, those that are read without an error.
    (Every byte, and every end: tests/exr/test_frame.py.)"""
    gbuffer, camera, _ = _small()
    dtype = np.dtype(method)
    gbuffer = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == np.float32 else x, gbuffer)
    camera = jax.tree.map(lambda x: x.astype(np.float32), camera)
    with tempfile.TemporaryDirectory() as folder:
        path, unnoticed = Path(folder) / "a.exr", 0
        exr.write_gbuffer(path, gbuffer, camera=camera)
        after, _ = exr.read_gbuffer(path)
        data, rng = path.read_bytes(), np.random.default_rng(0)
        for at in rng.integers(len(data), size=60):
            other = bytes([data[at] ^ int(rng.integers(1, 256))])
            for damaged in (data[:at] + other + data[at + 1 :], data[:at]):
                path.write_bytes(damaged)
                try:
                    exr.read_gbuffer(path)
                except ValueError:
                    continue
                unnoticed += 1
    pairs = zip(jax.tree.leaves(gbuffer), jax.tree.leaves(after), strict=True)
    bits = sum(int((np.asarray(a) != np.asarray(b)).sum()) for a, b in pairs)
    return Found(
        {"bits": float(bits), "unnoticed": float(unnoticed)}, np.asarray(after.diffuse)
    )


not_measured(
    "relight",
    "EXR in Blender",
    "There is no figure to it: Blender finds every pass under its name and to the bit, or a"
    " test in tests/exr fails. It is skipped where Blender is not installed.",
)


# The cases of materials and of light from all around, which come last.
import tests.cases.relight_materials  # noqa: E402
import tests.cases.relight_paths  # noqa: E402, F401
