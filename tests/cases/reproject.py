"""Where reprojection fails: what searches miss, and what an image can't show of a new view."""

import functools as ft
import itertools
import math
from typing import Any

import numpy as np

from benchmarks.scenes import reproject as scenes
from jaxfx import scene
from jaxfx.reproject import warp
from tests.cases.registry import Found, case, not_measured


# The oracle: a walk over every texel.


def grid_walk(
    depth: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[float, tuple[int, ...]] | None:
    """The time of the first t >= 0 with z(t) >= depth[floor y, floor x]; None for a miss.

    All crossings are sorted. A ray towards larger coordinates is in the next texel at the
    crossing (key 0), one towards smaller coordinates just after it (key 1).
    """
    height, width = depth.shape
    start = [float(v) for v in origin[:2]]
    events = [(0.0, 0)]
    for axis, size in ((0, width), (1, height)):
        if direction[axis] != 0:
            times = ((np.arange(size + 1) - start[axis]) / direction[axis]).tolist()
            events += [(t, int(direction[axis] < 0)) for t in times]
    events = [*sorted({event for event in events if event >= (0.0, 0)}), (math.inf, 0)]
    for now, after in itertools.pairwise(events):
        cell = [_cell(start[axis], direction[axis], now) for axis in (0, 1)]
        if 0 <= cell[0] < width and 0 <= cell[1] < height:
            time = _reach(depth[cell[1], cell[0]], origin[2], direction[2], now, after)
            if time is not None:
                return time, tuple(cell)
    return None


def _cell(start: float, slope: float, now: tuple[float, int]) -> int:
    """The row or column at a moment, by counting borders rather than by rounding a product."""
    if slope == 0:
        return math.floor(start)
    # The border k has been crossed if its moment is not later than now.
    guess = math.floor(start + now[0] * slope)
    candidates = range(guess - 2, guess + 3)
    if slope > 0:
        return max(k for k in candidates if ((k - start) / slope, 0) <= now)
    return min(k - 1 for k in (*candidates, guess + 3) if ((k - start) / slope, 1) <= now)


def _reach(
    depth: float, z: float, dz: float, now: tuple[float, int], after: tuple[float, int]
) -> float | None:
    """The first time in [now, after) at which the ray is as deep as a texel."""
    if not depth < math.inf:
        return None
    if dz > 0:
        time = max(now, ((depth - z) / dz, 0))
        return time[0] if time < after else None
    if dz == 0:
        return now[0] if z >= depth else None
    until = ((depth - z) / dz, 1)
    return now[0] if now < until else None


def field(size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Random depths with holes of every kind."""
    depth = rng.uniform(0.2, 1, size)
    kind = rng.random(size)
    depth[kind < 0.15] = np.inf
    depth[kind < 0.10] = 0
    depth[kind < 0.05] = np.nan
    return depth


def awkward_rays(
    size: tuple[int, int], rng: np.random.Generator, count: int = 150
) -> tuple[np.ndarray, np.ndarray]:
    """Half of them anywhere; half on borders and corners, along axes and diagonals."""
    side = max(size)
    origin = rng.uniform((-2, -2, -0.5), (side + 2, side + 2, 1.2), (2 * count, 3))
    direction = rng.normal(size=(2 * count, 3)) * (side / 2, side / 2, 1)
    origin[count:, :2] = np.round(origin[count:, :2] * 2) / 2
    origin[count:, 2] = np.round(origin[count:, 2] * 4) / 4
    direction[count:] = rng.choice([0, 1, -1, 2, -2, 0.5, -0.5], (count, 3))
    return origin, direction


def walked(depth: Any, origin: Any, direction: Any) -> tuple[np.ndarray, np.ndarray]:
    """Which rays hit, and where, by the walk."""
    known = np.where(depth > 0, depth, np.inf).astype(float)
    place, mask = np.array(origin, float), np.zeros(len(origin), bool)
    for k, (o, d) in enumerate(zip(place.copy(), np.array(direction, float), strict=True)):
        found = grid_walk(known, o, d)
        if found is not None:
            place[k], mask[k] = o + found[0] * d, True
    return mask, place


SEARCHES: dict[str, dict[str, Any]] = {
    "pyramid": {},
    "descent": {"search": "descent"},
    "linear, 8 steps": {"search": "linear", "max_steps": 8},
    "linear, 64 steps": {"search": "linear", "max_steps": 64},
    "relief, 8 steps": {"search": "relief", "max_steps": 8},
    "relief, 64 steps": {"search": "relief", "max_steps": 64},
}
QUICK = ("pyramid", "descent", "linear, 64 steps", "relief, 64 steps")
AT_THE_HIT = "exact, at the hit; missing: which texel it is"
AT_A_WRONG_HIT = "biased: of the texel that it takes for the hit; missing: which texel it is"
SAID = {name: AT_THE_HIT if name == "pyramid" else AT_A_WRONG_HIT for name in SEARCHES}
SIZES = [(size, np.float64) for size in ((1, 1), (2, 3), (5, 5), (17, 61), (64, 64), (257, 64))]
SIZES += [((17, 61), np.float32), ((257, 64), np.float32)]


@case("reproject", {"wrong": 0.0, "position": 1e-4}, QUICK, SAID)
def random_fields(method):
    """Against a walk over every texel, on random depths with holes; half of the 300 rays lie on
    borders and corners, along axes, or straight along the depth, to both sides: the share of
    rays that hit or miss wrongly, and the largest error of a right hit, in texels. "pyramid"
    at six sizes, up to 257x64, and at two of them in float32; the others at 64x64."""
    wrong, worst, count, depth = 0, 0.0, 0, None
    for size, dtype in SIZES if method == "pyramid" else [((64, 64), np.float64)]:
        rng = np.random.default_rng(size)
        depth = field(size, rng).astype(dtype)
        origin, direction = (x.astype(dtype) for x in awkward_rays(size, rng))
        hit = scenes.run(depth, origin, direction, **SEARCHES[method])
        mask, place = walked(depth, origin, direction)
        off = np.abs(np.asarray(hit.position) - place).max(axis=1)[mask & hit.mask]
        wrong, count = wrong + int((mask != hit.mask).sum()), count + len(mask)
        worst = max(worst, float(off.max(initial=0.0)))
    return Found({"wrong": wrong / count, "position": worst}, depth)


@ft.cache
def _chart(name: str, slope: float) -> tuple[Any, ...]:
    """A field of the chart, its rays, and every seventh of them walked."""
    depth = scenes.FIELDS[name](48)
    rays = scenes.slanted_rays(48, slope)
    return depth, *rays, *walked(depth, *(ray[::7] for ray in rays))


CHART = {"posts, from the front": ("posts", 0), "posts, slope 4": ("posts", 4)}
CHART |= {f"{name}, slope 16": (name, 16) for name in ("posts", "cliff", "smooth")}


@case("reproject", dict.fromkeys(CHART, 0.0), SEARCHES, SAID)
def posts_and_gaps(method):
    """Posts and gaps of one texel, a cliff and a smooth field, seen from the front and more and
    more at a grazing angle: the share of rays whose hit is wrong or more than a texel off."""
    figures, picture = {}, None
    for figure, key in CHART.items():
        depth, origin, direction, mask, place = _chart(*key)
        hit = scenes.run(depth, origin, direction, **SEARCHES[method])
        found = np.asarray(hit.mask)
        off = np.abs(np.asarray(hit.position)[::7] - place)[:, :2].max(axis=1) > 1
        figures[figure] = float(np.mean((found[::7] != mask) | (off & mask)))
        if figure == "posts, slope 16":
            shown = np.where(found, 1.1 - np.asarray(hit.position)[:, 2], np.nan)
            picture = shown.reshape(48, 48)
    return Found(figures, picture)


WARPS = {
    "pyramid": ("pyramid", np.float64),
    "pyramid, float32": ("pyramid", np.float32),
    "linear": ("linear", np.float64),
}


@case("reproject", {"image": 0.0, "alpha": 0.0}, WARPS)
def same_camera(method):
    """From its own camera an image of random depths, a fifth infinite, is to be itself: the
    largest difference, and the largest of alpha from 1."""
    search, dtype = WARPS[method]
    rng = np.random.default_rng(0)
    image = rng.random((24, 32, 3)).astype(dtype)
    depth = rng.uniform(1, 9, (24, 32)).astype(dtype)
    depth[rng.random((24, 32)) < 0.2] = np.inf
    eye = scenes.camera(at=(3.1, -2.2, 0.7), turn=0.3)
    drawn, alpha = map(np.asarray, warp(image, depth, eye, eye, search=search))
    figures = {"image": float(np.abs(drawn - image).max()), "alpha": float((1 - alpha).max())}
    return Found(figures, drawn)


# The still life turned: ours, Embree on a mesh of the depth, and the warp that is told the
# target's depth.


@ft.cache
def _source() -> tuple[Any, ...]:
    source, photograph = scenes.photographer(scene.still_life(), 96)
    image, depth = photograph(source)
    return source, photograph, image, depth, scenes.depth_mesh(depth, source)


@ft.cache
def _turned(degrees: int) -> tuple[Any, ...]:
    """The target, its true image and depth, and which pixels the source saw."""
    source, photograph, _, depth, _ = _source()
    target = scenes.orbit(source, degrees, 2.8)
    truth, target_depth = photograph(target)
    return target, truth, target_depth, scenes.visible(depth, source, target, target_depth)


VIEWS = {
    f"{peer}, {degrees} degrees": (peer, degrees)
    for degrees in (5, 20, 40)
    for peer in ("warp", "depth mesh", "target's depth")
}
HOLES = "exact, of the point that a pixel shows; missing: what comes into sight, and alpha's"


@case(
    "reproject",
    {"rms": 0.1, "false hits": 0.015, "false holes": 0.15, "not covered": None},
    VIEWS,
    {name: HOLES if peer == "warp" else "none: a peer" for name, (peer, _) in VIEWS.items()},
    needs="embreex",
)
def turned_view(method):
    """The still life turned about its middle, against rendering it again: rms error of pixels
    that are drawn and were seen; the shares of pixels drawn though unseen, and empty though
    seen (in red, both); and of those that stay empty. The peers: Embree on a mesh of the depth,
    and a backward warp that is told the target's depth."""
    peer, degrees = VIEWS[method]
    source, _, image, depth, mesh = _source()
    target, truth, target_depth, seen = _turned(degrees)
    if peer == "warp":
        drawn, alpha = warp(image, depth, source, target)
    elif peer == "depth mesh":
        drawn, alpha = scenes.trace(mesh, image, source, target, depth.shape)
    else:
        drawn, alpha = scenes.backward_warp(image, target_depth, source, target)
    score = scenes.scores(drawn, alpha, truth, seen)
    wrong = (np.asarray(alpha) > 0) != seen
    figures = {
        "rms": 10 ** (-score["PSNR"] / 20),
        "false hits": score["false hits"],
        "false holes": score["false holes"],
        "not covered": 1 - score["coverage"],
    }
    return Found(figures, np.where(wrong[..., None], np.nan, np.asarray(drawn)))


@case(
    "reproject",
    {"hits": 0.0, "not finite": 0.0, "changed far away": 1e-12, "most steps": None},
    (*QUICK, "warp"),
    {name: "zero, of a miss; missing: of holes, which open and close" for name in QUICK}
    | {"warp": HOLES},
)
def holes_in_depth(method):
    """Fields of nothing but 0, NaN, inf or -1, and rays that are not numbers: what is hit, and
    the steps of the longest search, which ends. A plane with a hole of 0 or NaN in depth and
    image, moved: pixels that are not finite, the largest change away from the hole."""
    return _holed_plane() if method == "warp" else _no_hits(method)


def _no_hits(method: str) -> Found:
    rng = np.random.default_rng(0)
    origin, direction = awkward_rays((24, 32), rng, 150)
    origin[:3, 0], direction[3:6, 1], origin[6:9, 2] = np.nan, np.nan, np.inf
    depth = field((24, 32), rng)
    hit = scenes.run(depth, origin, direction, **SEARCHES[method])
    hits, most = int(hit.mask[:9].sum()), int(hit.steps.max())
    for hole in (0.0, np.nan, np.inf, -1.0):
        hit = scenes.run(np.full((24, 32), hole), origin, direction, **SEARCHES[method])
        hits, most = hits + int(hit.mask.sum()), max(most, int(hit.steps.max()))
    return Found({"hits": float(hits), "most steps": float(most)}, depth)


def _holed_plane() -> Found:
    y, x = np.mgrid[:24, :32] / 24
    image = np.stack([np.sin(7 * x + y), np.cos(5 * y - x), x * y], axis=-1) / 2 + 0.5
    depth, eyes = np.full((24, 32), 2.0), (scenes.camera(), scenes.camera(at=(0.1, 0, 0)))
    draw = lambda image, depth: map(np.asarray, warp(image, depth, *eyes))
    (whole, _), picture, wrong, change = draw(image, depth), None, 0, 0.0
    far = np.ones((24, 32), bool)
    far[8:16, 8:18] = far[:, :3] = False
    for hole in (0.0, np.nan):
        holed, hurt = depth.copy(), image.copy()
        holed[10:14, 12:16], hurt[10:14, 12:16] = hole, np.nan
        drawn, alpha = draw(hurt, holed)
        wrong += int((~np.isfinite(drawn)).sum())
        change = max(change, float(np.abs(drawn - whole)[far].max()))
        picture = np.where(alpha[..., None] > 0, drawn, np.nan)
    return Found({"not finite": float(wrong), "changed far away": change}, picture)


SLOPES = {f"slope {slope}": slope for slope in (2, 6)}


@case("reproject", {"growth": 1.6, "steps": None}, SLOPES, "none: these are counts")
def steps_with_size(method):
    """Mean steps of "pyramid" of a ray over a smooth field at 128x128, over those at 32x32, the
    slant in texels growing with the image; and those at 128x128. (Times, from 256x256 to
    2048x2048: benchmarks/growth.py.)"""
    mean, shown = {}, None
    for size in (32, 128):
        origin, direction = scenes.slanted_rays(size, SLOPES[method] * size / 32)
        hit = scenes.run(scenes.smooth(size), origin, direction)
        inside = ((origin[:, :2] >= 0) & (origin[:, :2] < size)).all(axis=1)
        mean[size] = float(hit.steps[inside].mean())
        shown = np.asarray(hit.steps).reshape(size, size) / 40
    return Found({"growth": mean[128] / mean[32], "steps": mean[128]}, shown)


not_measured(
    "reproject",
    "time with size",
    "A wall-clock time is asserted by no test. benchmarks/growth.py has the time of a ray"
    " from 256x256 to 2048x2048, at every angle; docs/growth.png shows it.",
)
