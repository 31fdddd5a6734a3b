"""What the atlas measures: every method of every effect at several settings, on two scenes."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from jaxfx import (
    PinholeCamera,
    PointLight,
    SpotLight,
    ThinLens,
    blur,
    budget,
    dof,
    relight,
    reproject,
    scene,
    shadow,
)


STILL, FENCE, SPIKES, HILLS, POSTS = "still life", "fence", "spikes", "hills", "posts"
MAP_SIZE = 512
# Where the lamp of the shadows is, what it shines at, and its side, in each scene.
LAMPS = {
    STILL: ((-1.2, 2.6, -1.6), (0.0, 0.4, -3.8), 0.3),
    FENCE: ((-1.4, 2.6, 3.0), (0.0, 0.6, -1.0), 0.3),
}


class Point(NamedTuple):
    """Where methods are measured: a scene, the image's side and the effect's own size."""

    scene: str
    side: int
    own: int
    passes: int = 128


class Case(NamedTuple):
    """What the methods are given there, what they should give, and the pixels that count.

    `methods` holds functions of `data` by method and setting, the usual setting first. They
    hold nothing of the scene, so that one program serves both.
    """

    data: tuple
    truth: Any
    methods: dict[str, dict[str, Any]]
    counted: Any = None


class OnHost(NamedTuple):
    """A method that is no single program: its memory is not known."""

    call: Callable[..., Any]


class Planned(NamedTuple):
    """A method that is chosen by looking at the data; from an error to a plan."""

    plan: Callable[..., Any]


# --- The scenes


def fence():
    """Bars a few pixels wide before a card and a wall of tiles: thin things, hidden ones."""
    import trimesh
    from trimesh.visual import ColorVisuals

    rng, boxes = np.random.default_rng(0), []

    def box(low, high, color):
        one = trimesh.creation.box(bounds=[low, high])
        one.visual = ColorVisuals(one, face_colors=[*color, 1.0])
        boxes.append(one)

    box((-4, -0.2, -3), (4, 0, 3), (0.6, 0.6, 0.55))
    tile = np.array([0.48, 0.48, 0.1])
    for x, y in np.ndindex(16, 8):
        corner = np.array([-4 + x / 2, y / 2, -2.2])
        box(corner, corner + tile, rng.uniform(0.2, 1.0, 3))
    box((-0.5, 0.3, -1.0), (0.5, 1.3, -0.95), (0.9, 0.35, 0.2))
    for x in np.arange(-1.2, 1.25, 0.3):
        box((x, 0, 0.5), (x + 0.04, 1.6, 0.54), (0.15, 0.2, 0.3))
    found = scene.from_trimesh(trimesh.util.concatenate(boxes))
    return dataclasses.replace(
        found, viewpoint=scene.Viewpoint((0.5, 1.1, 3.4), (0.0, 0.8, -0.5), 0.7)
    )


mesh_of = functools.cache(lambda name: fence() if name == FENCE else scene.still_life())


@functools.cache
def view(name: str, side: int):
    """The mesh, its camera and the deep frame buffer, and what shades any other one."""
    mesh = mesh_of(name)
    camera = scene.default_camera(mesh, height=side, width=side)
    lights, shade = scene.default_lights(camera), jax.jit(relight.render)

    def render(eye, layer=0):
        gbuffer = scene.gbuffer(mesh, eye, height=side, width=side, layer_index=layer)
        return shade(gbuffer, eye, lights), gbuffer

    return camera, *render(camera), render


def orbit(camera: PinholeCamera, degrees: float, distance: float) -> PinholeCamera:
    """The camera turned about a point on its axis."""
    pose, angle = np.asarray(camera.world_from_camera, np.float64), np.deg2rad(degrees)
    sine, cosine = np.sin(angle), np.cos(angle)
    turn, pivot = np.eye(4), pose[:3, 3] + distance * pose[:3, 2]
    turn[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return PinholeCamera(camera.intrinsics, jnp.asarray(turn @ pose, jnp.float32))


# --- The effects


def depth_of_field(at: Point) -> Case:
    camera, _, gbuffer, render = view(at.scene, at.side)
    farthest = jnp.max(jnp.where(jnp.isfinite(gbuffer.depth), gbuffer.depth, 0))
    near_first = jnp.minimum(gbuffer.depth, farthest)  # An empty background would leak.
    focus = jnp.quantile(near_first, 0.75 if at.scene == FENCE else 1 / 3)
    unit = ThinLens.from_camera(camera, aperture=1.0, focus_distance=focus)
    aperture = at.own / jnp.max(unit.circle_of_confusion(near_first))
    lens = ThinLens(aperture, focus, unit.focal_pixels)

    def passes(count, aperture, seed, eye=lens):
        eye = ThinLens(aperture, eye.focus_distance, eye.focal_pixels)
        options = {"samples": count, "seed": seed, "progress": False}
        return dof.accumulate(lambda eye: render(eye)[0], camera, eye, **options).image

    image = passes(16, 0.0, 1)  # As antialiased as the reference.
    second, hidden = render(camera, layer=1)
    behind = second, jnp.minimum(hidden.depth, farthest)
    coc = 1.001 * at.own
    of = lambda method, **how: (
        lambda image, depth, lens, _: method(image, depth, lens, max_coc=coc, **how)
    )
    taps = at.side**2 * (at.own + 1) ** 2
    programs = ("shift", "tiles", "spans", *(["segment_sum"] if taps < 2**24 else []))
    methods = {
        "scatter": {"auto": of(dof.scatter), "gamma 1": of(dof.scatter, gamma=1.0)},
        **{f"scatter, {name}": {"": of(dof.scatter, program=name)} for name in programs},
        "layered": {
            "1 layer": of(dof.layered, behind=None),
            "1 layer, 1 guessed": of(dof.layered),
            "1 layer, 2 guessed": of(dof.layered, behind=("peel", "peel")),
            "split, 1 guessed": of(dof.layered, mixed="split"),
            "split, 2 guessed": of(dof.layered, behind=("peel", "peel"), mixed="split"),
            "2 layers": lambda image, depth, lens, behind: dof.layered(
                image, depth, lens, max_coc=coc, behind=[behind, None]
            ),
        },
        # The disc by the program of every other iris: the same image, another time.
        "layered, iris": {
            "1 layer": of(dof.layered, behind=None, iris=dof.Iris()),
            "1 layer, 1 guessed": of(dof.layered, iris=dof.Iris()),
        },
        "gather": {f"{n} taps": of(dof.gather, taps=n) for n in (32, 8, 128)},
        "depth sorted": {f"{n} slices": of(dof.depth_sorted, slices=n) for n in (8, 4, 16)},
        "blend": {"": of(dof.blend)},
        "separable": {"": of(dof.separable)},
        "anisotropic diffusion": {"": of(dof.anisotropic_diffusion)},
        "implicit diffusion": {"": of(dof.implicit_diffusion)},
        "multi-pass": {
            f"{n}": OnHost(lambda *_, n=n: passes(n, aperture, 1)) for n in (8, 4, 16, 32)
        },
        "plan": plans(budget.dof, lambda *data: data[:3]),
    }
    truth = passes(at.passes, aperture, 0)
    return Case((image, near_first, lens, behind), truth, methods)


def plans(
    plan: Callable[..., Any],
    given: Callable[..., Any],
    picture: Callable[..., Any] = lambda result, *data: result,
) -> dict[str, Planned]:
    """A plan for each of two errors, made for and called with what it is given of the data."""

    def make(error, *data):
        found = plan(*given(*data), max_error=error)
        return lambda *data: picture(found(*given(*data)), *data)

    return {f"{error:g}": Planned(functools.partial(make, error)) for error in (0.01, 0.03)}


def blurred(at: Point) -> Case:
    if at.scene == STILL:
        image = view(STILL, at.side)[1]
    else:  # Highlights over a step, and at the border.
        rng = np.random.default_rng(0)
        image = (rng.random((at.side, at.side, 3)) > 0.998) * np.float32(50)
        image[:, at.side // 2 :] += 1
    weights = np.asarray(blur.binomial_weights(9, row=12), np.float64)
    sigma = math.sqrt(at.own * weights @ (np.arange(9) - 4.0) ** 2)
    odd = lambda reach: 2 * max(1, math.ceil(reach)) + 1
    row = 2 * round(2 * sigma**2)

    def at_half(image, taps):
        half = blur.downsample(image, taps=taps)
        # What the halving and the way back blur already.
        rest = math.sqrt(max(sigma**2 - (1.25 if taps == 4 else 0.75), 0)) / 2
        half = blur.gaussian(half, sigma=rest, taps=odd(3 * rest))
        return jax.image.resize(half, image.shape, "linear")

    methods = {
        "one kernel": {
            f"{reach} sigma": lambda image, reach=reach: blur.gaussian(
                image, sigma=sigma, taps=odd(reach * sigma)
            )
            for reach in (3, 2, 4)
        },
        "Pascal's row": {
            f"{reach} sigma": lambda image, reach=reach: blur.gaussian(
                image, row=row, taps=min(odd(reach * sigma), row + 1)
            )
            for reach in (3, 2)
        },
        "9 taps composed": {"": lambda image: blur.gaussian(image, passes=at.own)},
        "9 taps composed, linear": {
            "": lambda image: blur.gaussian(image, passes=at.own, sampling="linear")
        },
        "at half size": {
            f"{taps} taps": functools.partial(at_half, taps=taps) for taps in (2, 4)
        },
    }
    truth = np.asarray(image, np.float64)
    for axis in (0, 1):
        how = {"axis": axis, "mode": "nearest", "truncate": 8.0}
        truth = scipy.ndimage.gaussian_filter1d(truth, sigma, **how)
    return Case((jnp.asarray(image),), truth.astype(np.float32), methods)


def warped(at: Point) -> Case:
    camera, _, gbuffer, render = view(at.scene, at.side)
    distance = float(jnp.median(gbuffer.depth))
    cameras = [orbit(camera, degrees, distance) for degrees in (0, 12, -8, 24)]
    images, buffers = zip(*map(render, cameras), strict=True)
    target = orbit(camera, at.own, distance)
    of = lambda method: (
        lambda images, depths, cameras, target: reproject.warp(
            images[0], depths[0], cameras[0], target, search=method
        )
    )
    few = lambda count: (
        lambda images, depths, cameras, target: reproject.blend(
            images[:count], depths[:count], cameras[:count], target
        )
    )
    # What is a hole is known to be one, and counts as right.
    over = lambda drawn, *data: jnp.where(drawn[1][..., None] > 0, drawn[0], data[-1])
    picture = lambda call: lambda *data: over(call(*data[:4]), *data)
    methods = {f"warp, {name}": {"": picture(of(name))} for name in SEARCHES} | {
        "blend": {f"{count} sources": picture(few(count)) for count in (2, 4)},
        "plan": plans(budget.reproject, lambda *data: data[:4], over),
    }
    truth, _ = render(target)
    data = (list(images), [buffer.depth for buffer in buffers], cameras, target, truth)
    return Case(data, truth, methods)


SEARCHES = ("pyramid", "descent", "linear", "relief")


def searched(at: Point) -> Case:
    """Slanting rays over a depth map, one for each texel; the image is the depths hit."""
    y, x = np.mgrid[: at.side, : at.side] / at.side
    depth = 0.6 + 0.15 * np.sin(9 * x + 3 * y) * np.cos(7 * y - x)
    if at.scene == POSTS:  # One texel wide, as its gaps are.
        depth[4::9, 4::9] = 0.3
        depth[:, at.side // 2 :] = 0.35
        depth[4::9, at.side // 2 + 4 :: 9] = 0.7
    way = at.side * np.array([0.25, 0.08])
    origin = np.dstack([at.side * np.dstack([x, y]) + 0.5 - way / 2, 0 * x])
    direction = np.broadcast_to([*way, 1.0], origin.shape)

    def of(method, steps):
        def call(depth, origin, direction):
            how = {"search": method, "max_steps": steps}
            hit = reproject.intersect(depth, origin, direction, **how)
            return jnp.where(hit.mask, hit.position[..., 2], 1.0)[..., None]

        return call

    methods = {
        name: {f"{n}": of(name, n) for n in dict.fromkeys((at.own, 8, 16, 128))}
        for name in ("pyramid", "linear", "relief")
    }
    methods["descent"] = {"": of("descent", None)}  # Its levels are all or nothing.
    data = tuple(jnp.asarray(array, jnp.float32) for array in (depth, origin, direction))
    return Case(data, of("pyramid", None)(*data), methods)


def shadowed(at: Point) -> Case:
    camera, _, gbuffer, _ = view(at.scene, at.side)
    mesh, (position, target, lamp) = mesh_of(at.scene), LAMPS[at.scene]
    light = SpotLight(position, np.subtract(target, position), [1.0, 1.0, 1.0], 0.7, 0.9)
    (eye,) = shadow.light_cameras(light, map_size=MAP_SIZE)
    shadow_map = scene.depth(mesh, eye, height=MAP_SIZE, width=MAP_SIZE)
    known = jnp.isfinite(gbuffer.depth)
    depth = jnp.where(known, gbuffer.depth, 1)
    receivers = shadow.receivers(depth, camera, eye, normal=gbuffer.normal)
    points = np.asarray(camera.points(depth))
    points = points + 2e-3 * np.asarray(gbuffer.normal)
    right, down = lamp * np.asarray(eye.world_from_camera)[:3, :2].T
    steps = (np.arange(6) + 0.5) / 6 - 0.5
    ends = [np.array(position) + a * right + b * down for a in steps for b in steps]
    lit = np.stack([scene.visible(mesh, points, end) for end in ends])
    facing = np.sum((np.array(position) - points) * np.asarray(gbuffer.normal), -1) > 0.1
    inside = np.abs(np.stack(receivers[:2]) - MAP_SIZE / 2).max(axis=0) < 0.47 * MAP_SIZE

    def of(method, slope, **how):
        def call(shadow_map, receivers, eye):
            data = (shadow_map, receivers, *([eye] if method is shadow.pcss else []))
            return method(*data, bias=0.01, slope_bias=slope / 2, **how)[..., None]

        return call

    sizes = tuple(dict.fromkeys((at.own, 3, 7, 15)))
    several = lambda method, **how: {f"{n}": of(method, n, size=n, **how) for n in sizes}
    one = lambda method, **how: {"": of(method, at.own, size=at.own, **how)}
    reach = lambda n: {"size": n, "edges": "screen", "dilation": n // 2 + 2}
    plan = functools.partial(budget.shadow, size=at.own, bias=0.01, slope_bias=at.own / 2)
    methods = {
        "hard": {"": of(shadow.hard, 1)},
        "pcf": several(shadow.pcf),
        "pcf, tent": one(shadow.pcf, kernel="tent"),
        "pcf, Gaussian": one(shadow.pcf, kernel="gaussian"),
        "edges by depth": several(shadow.edge_pcf, edges="depth"),
        "edges by screen": {f"{n}": of(shadow.edge_pcf, n, **reach(n)) for n in sizes},
        "prefiltered": several(shadow.prefiltered),
        "variance": several(shadow.variance),
        "pcss": several(shadow.pcss, light_size=lamp),
        "plan": plans(plan, lambda *data: data[:2], lambda result, *_: result[..., None]),
    }
    data, counted = (shadow_map, receivers, eye), np.asarray(known) & inside & facing
    return Case(data, lit.mean(axis=0, dtype=np.float32)[..., None], methods, counted)


def relit(at: Point) -> Case:
    camera, _, gbuffer, render = view(at.scene, at.side)
    rng = np.random.default_rng(0)
    low, high = mesh_of(at.scene).bounds
    places = low + (high - low) * rng.uniform([0.2, 0.7, 0.5], [0.8, 1.2, 1.3], (at.own + 1, 3))
    power = 0.8 ** np.arange(at.own + 1)  # Some matter more than others.
    power = power / np.sum(power[:-1]) * 0.15 * np.sum((high - low) ** 2)
    *lights, other = (
        PointLight(place.astype(np.float32), np.full(3, p, np.float32))
        for place, p in zip(places, power, strict=True)
    )
    # The cache with what the pixel in the middle is made of painted black, and dull.
    middle = gbuffer.depth.shape[0] // 2
    same = lambda values: (values == values[middle, middle]).reshape(*gbuffer.depth.shape, -1)
    mask = same(gbuffer.diffuse).all(-1) & same(gbuffer.roughness).all(-1)
    without = jnp.where(mask[..., None], 0, gbuffer.diffuse)
    black = eqx.tree_at(lambda g: g.diffuse, gbuffer, without)
    duller = jnp.where(mask, 1, gbuffer.roughness)
    dull = eqx.tree_at(lambda g: g.roughness, gbuffer, duller)
    start = lambda gbuffer, lights: relight.start(gbuffer, camera, lights)
    distance = float(jnp.median(gbuffer.depth))
    cameras = [orbit(camera, degrees, distance) for degrees in (-8, 8, 16, -16)]
    data = {
        "of": (gbuffer, camera, lights),
        "new": (lights[0], lights[-1]),
        "edit": start(gbuffer, [other, *lights[1:]]),
        "add": start(gbuffer, lights[:-1]),
        "remove": start(gbuffer, [*lights, other]),
        "paint": (mask, gbuffer.diffuse[middle, middle], gbuffer.roughness[middle, middle]),
        "black": start(black, lights),
        "dull": start(dull, lights),
        "caches": ([render(eye)[1] for eye in cameras], cameras),
    }

    def new_view(count, **how):
        def call(data):
            caches, eyes = (each[:count] for each in data["caches"])
            gbuffer, camera, lights = data["of"]
            found, views = relight.synthesize(caches, eyes, camera, depth=gbuffer.depth, **how)
            return relight.render(relight.fill_holes(found, views)[0], camera, lights)

        return call

    methods = {
        "render": {"": lambda data: relight.render(*data["of"])},
        "start": {"": lambda data: relight.start(*data["of"]).image},
        "edit": {"": lambda data: data["edit"].edit(0, data["new"][0]).image},
        "add": {"": lambda data: data["add"].add(data["new"][1]).image},
        "remove": {"": lambda data: data["remove"].remove(len(data["of"][2])).image},
        "paint": {
            "diffuse": lambda data: (
                data["black"].paint(data["paint"][0], diffuse=data["paint"][1]).image
            ),
            "roughness": lambda data: (
                data["dull"].paint(data["paint"][0], roughness=data["paint"][2]).image
            ),
        },
        "new view": {f"from {n}": new_view(n) for n in (4, 1, 2)}
        | {"from 4, by detail": new_view(4, weighting="detail")},
        "plan": plans(budget.relight, lambda data: data["of"]),
    }
    return Case((data,), relight.render(*data["of"]), methods)


@functools.cache
def transfer(name: str, side: int):
    """How light goes by way of 256 points, with every singular vector."""
    camera, _, gbuffer, _ = view(name, side)
    return scene.transfer(mesh_of(name), gbuffer, camera, point_count=256, rank=256)


def bounced(at: Point) -> Case:
    camera, _, gbuffer, _ = view(at.scene, at.side)
    whole, lights = transfer(at.scene, at.side), scene.default_lights(camera)
    cut = lambda rank: eqx.tree_at(
        lambda t: (t.receive, t.send), whole, (whole.receive[..., :rank], whole.send[:rank])
    )
    ranks = tuple(dict.fromkeys((at.own, 4, 16, 128)))
    methods = {
        "indirect": {
            f"rank {rank}": lambda transfers, gbuffer, lights, rank=rank: relight.indirect(
                gbuffer, transfers[rank], lights
            )
            for rank in ranks
        }
    }
    truth = relight.indirect(gbuffer, whole, lights)
    return Case(({rank: cut(rank) for rank in ranks}, gbuffer, lights), truth, methods)
