"""Where depth of field fails: cases with a known truth, and how far off each method is.

`python tests/benchmarks/dof_cases.py` prints the figures of all methods as JSON, the published
ones of `tests/dof/failures.json`.
"""

import functools as ft
import inspect
import itertools
import json
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, ThinLens, dof


SIZE, RADIUS, MAX_COC = 46, 6.0, 12.0
MIDDLE = SIZE // 2
# Signed distance of the pixels of a row from the middle of the picture, where edges are.
COLUMNS = np.arange(SIZE) + 0.5 - MIDDLE

# What each figure may be at the most for the case to count as passed.
PASSES = {
    "constant": 1e-5,
    "slanted plane": 0.01,
    "energy": 1e-5,
    "centroid": 1e-3,
    "second moment": 0.05,
    "jump": 0.6,
    "unevenness": 2.0,
    "blurred foreground": 0.02,
    "sharp foreground": 0.01,
    "thin bar": 0.01,
    "highlight": 1e-3,
    "reach of a NaN": RADIUS + 1.5,
    "gradient": 1e-4,
    "not finite": 0.0,
}


def methods() -> dict[str, Callable[..., Any]]:
    """Every method of `dof` that takes an image, its depth and a lens."""
    named = {name: getattr(dof, name) for name in dof.__all__}
    return {
        name: method
        for name, method in named.items()
        if inspect.isfunction(inspect.unwrap(method))
        and list(inspect.signature(method).parameters)[:3] == ["image", "depth", "lens"]
    }


class Scene(NamedTuple):
    """What a ray meets; the lens; what the lens would see; and the pixels that count."""

    cast: Callable[[Any, Any], tuple[Any, Any]]
    lens: ThinLens
    truth: np.ndarray
    counted: np.ndarray

    def through(self, camera: PinholeCamera) -> tuple[Any, Any]:
        """The image and the depth that a pinhole camera sees."""
        pixels = np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), axis=-1)
        origin = camera.world_from_camera[:3, 3]
        ahead = camera.unproject(jnp.asarray(pixels), jnp.ones((SIZE, SIZE)))
        color, depth = self.cast(origin, ahead - origin[None, None])
        return color[..., None], depth

    def accumulated(self, samples: int = 1024) -> Any:
        """The multi-pass reference of the scene itself."""
        render = jax.jit(lambda camera: self.through(camera)[0])
        options = {"samples": samples, "jitter": False, "progress": False}
        return dof.accumulate(render, CAMERA, self.lens, **options).image


CAMERA = PinholeCamera(np.array([[SIZE, 0, MIDDLE], [0, SIZE, MIDDLE], [0, 0, 1.0]]), np.eye(4))


def scenes() -> dict[str, list[Scene]]:
    """The cases with a picture to look at, by name."""
    share = covered(COLUMNS, RADIUS)
    band = np.abs(COLUMNS) < RADIUS + 1
    return {
        "slanted plane": [slanted()],
        "blurred foreground": [edge(2.0, share, band)],
        "sharp foreground": [edge(1.0, COLUMNS < 0, band)],
        "thin bar": [bar(width) for width in (1, 2, 3)],
    }


def covered(distance: np.ndarray, radius: float) -> np.ndarray:
    """The share of a disc on the far side of a line at a distance from its centre."""
    s = np.clip(distance / radius, -1, 1)
    return 0.5 - (s * np.sqrt(1 - s * s) + np.arcsin(s)) / np.pi


def _lens(focus: float, coc: float, depth: float) -> ThinLens:
    return ThinLens(coc / SIZE / abs(1 / focus - 1 / depth), focus, SIZE)


def edge(focus: float, truth: np.ndarray, counted: np.ndarray) -> Scene:
    """A white half-plane at depth 1, on the left, before a black one at 2."""

    def cast(origin, direction):
        x = origin[0] + (1 - origin[2]) * direction[..., 0]
        return jnp.where(x < 0, 1.0, 0.0), jnp.where(x < 0, 1.0, 2.0)

    return Scene(cast, _lens(focus, MAX_COC, 3.0 - focus), truth * 1.0, counted)


def bar(width: int) -> Scene:
    """A dim bar in focus, some pixels wide, before a bright field infinitely far away."""

    def cast(origin, direction):
        x = SIZE * (origin[0] + (1 - origin[2]) * direction[..., 0])
        inside = (x > 0) & (x < width)
        return jnp.where(inside, 0.04, 1.0), jnp.where(inside, 1.0, jnp.inf)

    inside = np.abs(COLUMNS - width / 2) < width / 2
    band = np.abs(COLUMNS - width / 2) < RADIUS + width / 2
    return Scene(cast, _lens(1.0, MAX_COC, np.inf), np.where(inside, 0.04, 1.0), band)


def slanted() -> Scene:
    """An opaque plane through focus, blurred by 10 pixels at both ends, of linear colour."""

    def cast(origin, direction):
        # 1 / depth = 1/2 - (x - middle) / (4 middle) in the picture of the lens' centre.
        normal = jnp.array([-0.5, 0.0, 0.5])
        hit = (1 - jnp.vdot(normal, origin)) / jnp.sum(normal[None, None] * direction, axis=-1)
        point = origin[None, None] + hit[..., None] * direction
        return 0.5 + point[..., 0] / point[..., 2], point[..., 2]

    # A point x from the middle is seen at x (1 + a s), s being its place on the lens from -1 to
    # 1; the mean of 1 / (1 + a s) over a disc is this.
    a = 5 / MIDDLE
    mean = 2 * (1 - np.sqrt(1 - a * a)) / (a * a)
    truth = 0.5 + mean * COLUMNS / SIZE
    return Scene(cast, _lens(2.0, 10, 4 / 3), truth, np.abs(COLUMNS) < MIDDLE - MAX_COC)


def error(scene: Scene, picture: Any) -> float:
    """The root-mean-square error of the middle row, where it counts."""
    row = np.asarray(picture)[MIDDLE, :, 0]
    return float(np.sqrt(np.mean((row - scene.truth)[scene.counted] ** 2)))


def figures(method: Callable[..., Any]) -> dict[str, float]:
    """Every figure of a method. One size and one `max_coc`, so three programs are compiled."""
    picture = jax.jit(ft.partial(method, max_coc=MAX_COC))
    found = {
        name: max(
            error(scene, picture(*scene.through(CAMERA), scene.lens)) for scene in several
        )
        for name, several in scenes().items()
    }
    found |= _rounding(picture) | _point(picture) | _gradient(picture)
    found |= _sweep(picture)
    found["reach of a NaN"] = _reach(picture)
    return {name: found[name] for name in PASSES}


def accumulated_figures() -> dict[str, float]:
    """Those of the multi-pass reference, where there is a scene to be seen from elsewhere."""
    return {
        name: max(error(scene, scene.accumulated()) for scene in several)
        for name, several in scenes().items()
    }


def _random(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A picture, and depths of which some are infinite, in focus or next to the lens."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 8.0, (SIZE, SIZE))
    special = rng.choice([0.01, 2.5, np.inf, np.nan], (SIZE, SIZE), p=[0.01, 0.1, 0.1, 0.79])
    depth = np.where(np.isnan(special), depth, special)
    return rng.uniform(0.05, 0.2, (SIZE, SIZE, 1)), depth


LENS = ThinLens(0.25, 2.5, 60.0)


def _single(*arrays: np.ndarray) -> list[Any]:
    return [jnp.asarray(array, jnp.float32) for array in arrays]


def _rounding(picture: Callable[..., Any]) -> dict[str, float]:
    """A constant picture, and one with a highlight, in single precision."""
    image, depth = _random()
    constant = picture(*_single(np.full_like(image, 0.7), depth), LENS)
    image[20, 24] = 1e6
    exact = np.asarray(picture(image, depth, LENS))
    single = np.asarray(picture(*_single(image, depth), LENS))
    dim = exact < 0.2
    return {
        "constant": float(np.abs(np.asarray(constant) - 0.7).max()),
        "highlight": float(np.abs(single / exact - 1)[dim].max()),
    }


def _point(picture: Callable[..., Any], radius: float = 4.5) -> dict[str, float]:
    """A single bright pixel, all at one depth."""
    image = np.zeros((SIZE, SIZE, 1))
    image[MIDDLE, MIDDLE] = 1
    spread = picture(image, np.full((SIZE, SIZE), np.inf), ThinLens(1.0, 1.0, 2 * radius))
    spread = np.asarray(spread)[..., 0]
    offset = np.arange(SIZE) - MIDDLE
    centroid = np.hypot((spread * offset).sum(), (spread * offset[:, None]).sum())
    second = (spread * (offset**2 + offset[:, None] ** 2)).sum() / spread.sum()
    return {
        "energy": float(abs(spread.sum() - 1)),
        "centroid": float(centroid),
        "second moment": float(abs(second / (radius**2 / 2) - 1)),
    }


def _sweep(picture: Callable[..., Any]) -> dict[str, float]:
    """The changes of a picture as the radius goes from 0 to 2 pixels in steps of 0.05.

    The largest over the mean one; and over the largest of steps twice as long, which is a half
    for a slope and 1 for a jump.
    """
    image, _ = _random()
    depth = np.full((SIZE, SIZE), np.inf)
    radii = np.arange(0, 2.025, 0.05)
    pictures = [picture(image, depth, ThinLens(1.0, 1.0, 2 * r + 1e-9)) for r in radii]
    change = lambda pair: float(np.abs(pair[1] - pair[0]).max())
    steps = [change(pair) for pair in itertools.pairwise(pictures)]
    strides = [change(pair) for pair in zip(pictures, pictures[2:], strict=False)]
    return {"jump": max(steps) / max(strides), "unevenness": max(steps) / np.mean(steps)}


def _reach(picture: Callable[..., Any]) -> float:
    """How far from a pixel that is not a number another is not, in pixels."""
    image, _ = _random()
    image[MIDDLE, MIDDLE] = np.nan
    lens = ThinLens(1.0, 1.0, MAX_COC)
    spoiled = np.isnan(picture(image, np.full((SIZE, SIZE), np.inf), lens))[..., 0]
    row, column = np.nonzero(spoiled)
    return float(np.hypot(row - MIDDLE, column - MIDDLE).max())


def _gradient(picture: Callable[..., Any]) -> dict[str, float]:
    """How far derivatives lie outside the two one-sided difference quotients.

    In the aperture and in the focus distance, with pixels at focus, at infinity and clamped;
    over the largest derivative. And how many values, of those or for worse input, are not
    finite.
    """
    image, depth = _random()
    seen = lambda lens: picture(image, depth, ThinLens(lens[0], lens[1], 60.0))
    push = jax.jit(lambda lens, along: jax.jvp(seen, (lens,), (along,)))
    lens, step, worst, wrong = jnp.array([0.25, 2.5]), 1e-6, 0.0, 0
    for along in jnp.eye(2):
        value, slope = push(lens, along)
        before = (value - seen(lens - step * along)) / step
        after = (seen(lens + step * along) - value) / step
        nearest = jnp.clip(slope, jnp.minimum(before, after), jnp.maximum(before, after))
        worst = max(worst, float(jnp.abs(slope - nearest).max() / jnp.abs(slope).max()))
        wrong += int((~jnp.isfinite(slope)).sum())
    for z in (0.0, 1e-30, 1e30):
        spiked = depth.copy()
        spiked[::7, ::5] = z
        wrong += int((~jnp.isfinite(picture(image, spiked, LENS))).sum())
    return {"gradient": worst, "not finite": float(wrong)}


def main() -> None:
    """Print the figures of all methods."""
    jax.config.update("jax_enable_x64", True)
    published = {name: figures(method) for name, method in methods().items()}
    published["accumulate"] = accumulated_figures()
    rounded = {
        name: {case: float(f"{figure:.3g}") for case, figure in each.items()}
        for name, each in published.items()
    }
    json.dump(rounded, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
