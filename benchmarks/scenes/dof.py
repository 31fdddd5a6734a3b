"""Scenes of depth of field with known results, and every method compiled for them."""

import functools as ft
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, ThinLens, dof


# Side of the image, radius of the blurred halves, and `max_coc`, all in pixels. The radius is a
# little smaller than half of `max_coc`, at which circles are clamped.
SIZE, RADIUS, MAX_COC = 46, 5.9, 12.0
MIDDLE = SIZE // 2
# Signed distance of a row's pixels from the middle of the image, where edges are.
COLUMNS = np.arange(SIZE) + 0.5 - MIDDLE


def methods() -> dict[str, Callable[..., Any]]:
    """Every method of `dof` that takes an image, its depth and a lens."""
    # `peel` gives a second layer, no picture.
    named = {name: getattr(dof, name) for name in dof.__all__ if name != "peel"}
    return {
        name: method
        for name, method in named.items()
        if inspect.isfunction(inspect.unwrap(method))
        and list(inspect.signature(method).parameters)[:3] == ["image", "depth", "lens"]
    }


METHODS = tuple(methods())

# The settings that are charted beside a method's default. Strings are static; numbers are
# traced, so that settings which differ in numbers only share one program.
SETTINGS: dict[str, dict[str, Any]] = {
    "scatter, gamma 1": {"gamma": 1.0},
    "scatter, gamma 3": {"gamma": 3.0},
    "scatter, gamma 50": {"gamma": 50.0},
    "scatter, epsilon 0": {"epsilon": 0.0},
    "scatter, epsilon 40": {"epsilon": 40.0},
    "scatter, spans": {"program": "spans"},
    "scatter, indicator": {"program": "segment_sum", "coverage": "indicator"},
    "depth_sorted, all": {"slices": "all"},
    "layered, split": {"mixed": "split"},
    "layered, reflect": {"pad": "reflect"},
}


@ft.cache
def _program(name: str, *static: tuple[str, str]) -> Callable[..., Any]:
    return jax.jit(ft.partial(methods()[name], max_coc=MAX_COC, **dict(static)))


def blurred(method: str) -> Callable[..., Any]:
    """The compiled function of image, depth and lens, of a method or one of `SETTINGS`."""
    name, options = method.partition(",")[0], SETTINGS.get(method, {})
    static = {key: value for key, value in options.items() if isinstance(value, str)}
    traced = {key: value for key, value in options.items() if key not in static}
    if name == "scatter":
        traced = {"gamma": 0.0, "epsilon": 2.0} | traced
    return ft.partial(_program(name, *static.items()), **traced)


@ft.cache
def _derivative(name: str) -> Callable[..., Any]:
    """The directional derivative of a method, compiled with little optimisation.

    It is a function of image, depth, lens, and a direction in depth, aperture and focus.
    """

    def push(image, depth, lens, along, options):
        def seen(depth, aperture, focus):
            moved = ThinLens(aperture, focus, lens.focal_pixels)
            return methods()[name](image, depth, moved, max_coc=MAX_COC, **options)

        at = (jnp.asarray(depth), lens.aperture, lens.focus_distance)
        return jax.jvp(seen, at, along)[1]

    return jax.jit(push, compiler_options={"xla_backend_optimization_level": 0})


def derivative(method: str, image: Any, depth: Any, lens: ThinLens, along: Any) -> np.ndarray:
    """The directional derivative of a method's image, as the method computes it."""
    run = blurred(method)
    return np.asarray(
        _derivative(method.partition(",")[0])(image, depth, lens, along, run.keywords)
    )


def directions(depth: Any, seed: int = 1) -> list[tuple[Any, Any, Any]]:
    """Directions along the aperture, along the focus, and in all finite depths at random."""
    random = np.random.default_rng(seed).normal(size=np.shape(depth))
    move = jnp.where(jnp.isfinite(depth), 0.1 * random, 0.0)
    zero, one = jnp.zeros(()), jnp.ones(())
    return [(0 * move, one, zero), (0 * move, zero, one), (move, zero, zero)]


def off_quotients(method: str, image: Any, depth: Any, lens: ThinLens) -> dict[str, float]:
    """How far derivatives lie outside the interval of the two one-sided difference quotients.

    It is the worst over aperture, focus and depth, relative to the largest derivative (1e-3 at
    least). Then how many derivatives are not finite.
    """
    run, step, worst, not_finite = blurred(method), 1e-6, 0.0, 0
    value = np.asarray(run(image, depth, lens))
    for along in directions(depth):
        slope = derivative(method, image, depth, lens, along)
        at = (jnp.asarray(depth), lens.aperture, lens.focus_distance)

        def moved(by, at=at, along=along):
            place, aperture, focus = (x + by * d for x, d in zip(at, along, strict=True))
            return np.asarray(run(image, place, ThinLens(aperture, focus, lens.focal_pixels)))

        before, after = (value - moved(-step)) / step, (moved(step) - value) / step
        nearest = np.clip(slope, np.minimum(before, after), np.maximum(before, after))
        largest = max(float(np.abs(slope).max()), 1e-3)
        worst = max(worst, float(np.abs(slope - nearest).max()) / largest)
        not_finite += int((~np.isfinite(slope)).sum())
    return {"gradient": worst, "not finite": float(not_finite)}


class Scene(NamedTuple):
    """A scene with the exact image through a lens.

    - `cast`: colour and depth that rays, by origin and direction, meet.
    - `lens`: the lens.
    - `seen`: a row of the exact image, as a function of a factor of the aperture.
    - `counted`: the pixels of the row that are scored.
    """

    cast: Callable[[Any, Any], tuple[Any, Any]]
    lens: ThinLens
    seen: Callable[[float], np.ndarray]
    counted: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        """A row of the exact image."""
        return self.seen(1.0)

    @property
    def slope(self) -> np.ndarray:
        """Its derivative in the logarithm of the aperture."""
        return (self.seen(1 + 1e-5) - self.seen(1 - 1e-5)) / 2e-5

    def through(self, camera: PinholeCamera) -> tuple[Any, Any]:
        """The image and the depth that a pinhole camera sees."""
        pixels = np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), axis=-1)
        origin = camera.world_from_camera[:3, 3]
        ahead = camera.unproject(jnp.asarray(pixels), jnp.ones((SIZE, SIZE)))
        color, depth = self.cast(origin, ahead - origin[None, None])
        return color[..., None], depth

    def accumulated(self, samples: int = 256) -> Any:
        """The multi-pass reference."""
        render = jax.jit(lambda camera: self.through(camera)[0])
        options = {"samples": samples, "jitter": False, "progress": False}
        return dof.accumulate(render, CAMERA, self.lens, **options).image


CAMERA = PinholeCamera(np.array([[SIZE, 0, MIDDLE], [0, SIZE, MIDDLE], [0, 0, 1.0]]), np.eye(4))


def covered(distance: np.ndarray, radius: float) -> np.ndarray:
    """The fraction of a disc beyond a line at a signed distance from its centre."""
    s = np.clip(distance / radius, -1, 1)
    return 0.5 - (s * np.sqrt(1 - s * s) + np.arcsin(s)) / np.pi


def _lens(focus: float, coc: float, depth: float) -> ThinLens:
    return ThinLens(coc / SIZE / abs(1 / focus - 1 / depth), focus, SIZE)


def edge(focus: float, seen: Callable[[float], np.ndarray]) -> Scene:
    """A white half-plane at depth 1, on the left, before a black plane at depth 2."""

    def cast(origin, direction):
        x = origin[0] + (1 - origin[2]) * direction[..., 0]
        return jnp.where(x < 0, 1.0, 0.0), jnp.where(x < 0, 1.0, 2.0)

    band = np.abs(COLUMNS) < RADIUS + 1
    return Scene(cast, _lens(focus, 2 * RADIUS, 3.0 - focus), seen, band)


def bar(width: int) -> Scene:
    """A dim bar in focus, `width` pixels wide, before a bright background at infinity."""

    def cast(origin, direction):
        x = SIZE * (origin[0] + (1 - origin[2]) * direction[..., 0])
        inside = (x > 0) & (x < width)
        return jnp.where(inside, 0.04, 1.0), jnp.where(inside, 1.0, jnp.inf)

    inside = np.abs(COLUMNS - width / 2) < width / 2
    band = np.abs(COLUMNS - width / 2) < RADIUS + width / 2
    truth = np.where(inside, 0.04, 1.0)
    return Scene(cast, _lens(1.0, 2 * RADIUS, np.inf), lambda scale: truth, band)


def slanted() -> Scene:
    """A slanted plane through the focus plane, blurred by 10 pixels at both ends."""

    def cast(origin, direction):
        # 1 / depth = 1/2 - (x - middle) / (4 middle) in the pinhole image.
        normal = jnp.array([-0.5, 0.0, 0.5])
        hit = (1 - jnp.vdot(normal, origin)) / jnp.sum(normal[None, None] * direction, axis=-1)
        point = origin[None, None] + hit[..., None] * direction
        return 0.5 + point[..., 0] / point[..., 2], point[..., 2]

    # A point at x from the middle is seen at x (1 + a s) from the lens position s in [-1, 1].
    # The formula is the mean of 1 / (1 + a s) over the disc of the lens.
    def seen(scale):
        a = 5 * scale / MIDDLE
        return 0.5 + 2 * (1 - np.sqrt(1 - a * a)) / (a * a) * COLUMNS / SIZE

    return Scene(cast, _lens(2.0, 10, 4 / 3), seen, np.abs(COLUMNS) < MIDDLE - MAX_COC)


@ft.cache
def scenes() -> dict[str, list[Scene]]:
    """The cases that have an image, by name."""
    return {
        "slanted plane": [slanted()],
        "blurred foreground": [edge(2.0, lambda scale: covered(COLUMNS, RADIUS * scale))],
        "sharp foreground": [edge(1.0, lambda scale: 1.0 * (COLUMNS < 0))],
        "thin bar": [bar(width) for width in (1, 2, 3)],
    }


LENS = ThinLens(0.25, 2.5, 60.0)


@ft.cache
def random_picture() -> tuple[np.ndarray, np.ndarray]:
    """A random image, and depths of which some are infinite, in focus or next to the lens."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.0, 8.0, (SIZE, SIZE))
    special = rng.choice([0.01, 2.5, np.inf, np.nan], (SIZE, SIZE), p=[0.01, 0.1, 0.1, 0.79])
    depth = np.where(np.isnan(special), depth, special)
    return rng.uniform(0.05, 0.2, (SIZE, SIZE, 1)), depth


def in_float32(*arrays: np.ndarray) -> list[Any]:
    """The arrays in float32."""
    return [jnp.asarray(array, jnp.float32) for array in arrays]


FLAT = np.full((SIZE, SIZE), np.inf)
