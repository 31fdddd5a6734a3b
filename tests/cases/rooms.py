"""Rooms of textured boxes, seen by closed form: pairs of photographs of any overlap."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfx import PinholeCamera, ThinLens, dof


class Room(NamedTuple):
    """The walls as one box seen from inside, and boxes in it; each has waves for a texture.

    - `low`, `high`: box 3, scene units; the first is the room.
    - `waves`: box channel wave 3, radians per scene unit; `phases`: box channel wave.
    """

    low: np.ndarray
    high: np.ndarray
    waves: np.ndarray
    phases: np.ndarray


def room(seed: int, boxes: int = 6, finest: float = 14.0) -> Room:
    """A room of 5 x 3 x 5 with boxes along its walls."""
    rng = np.random.default_rng(seed)
    low, high = [np.array([-2.5, -1.5, -2.5])], [np.array([2.5, 1.5, 2.5])]
    for _ in range(boxes):
        angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.6, 3)
        middle = np.array([2 * np.cos(angle), rng.uniform(-1, 1), 2 * np.sin(angle)])
        low.append(middle - size / 2)
        high.append(middle + size / 2)
    frequency = np.exp(rng.uniform(np.log(1.5), np.log(finest), (boxes + 1, 3, 12, 1)))
    direction = rng.normal(size=(boxes + 1, 3, 12, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    phases = rng.uniform(0, 2 * np.pi, (boxes + 1, 3, 12))
    return Room(np.array(low), np.array(high), frequency * direction, phases)


def seen(
    place: Room, pose: np.ndarray, size: tuple[int, int], fov: float = 1.1, samples: int = 3
) -> tuple[np.ndarray, np.ndarray, PinholeCamera]:
    """The image, averaged over samples x samples rays a pixel; the depth of pixels' middles."""
    camera = PinholeCamera.from_fov(fov, height=size[0], width=size[1], world_from_camera=pose)
    inverse = np.linalg.inv(np.asarray(camera.intrinsics, float))
    colors = [
        cast(place, pose, inverse, size, ((i + 0.5) / samples, (j + 0.5) / samples))[0]
        for i in range(samples)
        for j in range(samples)
    ]
    depth = cast(place, pose, inverse, size, (0.5, 0.5))[1]
    return np.mean(colors, axis=0).astype(np.float32), depth.astype(np.float32), camera


def cast(place, pose, inverse, size, at):
    """Color and depth along the axis, of the first box that a ray meets, by slabs."""
    y, x = np.indices(size)
    pixels = np.stack([x + at[0], y + at[1], np.ones(size)], axis=-1)
    direction = pixels @ inverse.T @ pose[:3, :3].T
    origin = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([place.low, place.high])[:, :, None, None]
        times = (sides - origin) / direction
    enter, leave = times.min(axis=0).max(axis=-1), times.max(axis=0).min(axis=-1)
    meets = (enter < leave) & (enter > 0)
    time = np.where(meets, enter, np.inf)
    time[0] = leave[0]
    first = time.argmin(axis=0)
    depth = np.take_along_axis(time, first[None], axis=0)[0]
    point = origin + depth[..., None] * direction
    waves, phases = place.waves[first], place.phases[first]
    texture = np.sin(np.einsum("...cwk,...k->...cw", waves, point) + phases)
    return 0.5 + 0.12 * texture.sum(axis=-1) / np.sqrt(2), depth


def pose(turn: float, tilt: float, shift: np.ndarray) -> np.ndarray:
    """A camera turned about the vertical and tilted, in radians, at a point."""
    c, s, d, t = np.cos(turn), np.sin(turn), np.cos(tilt), np.sin(tilt)
    about = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    down = np.array([[1, 0, 0], [0, d, -t], [0, t, d]])
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = about @ down, shift
    return made


def through_a_lens(seed: int, size: tuple[int, int] = (48, 64), samples: int = 64):
    """A photograph by many passes, image and depth from the lens' middle, the lens, a start.

    The focus lies within what is seen, the largest circle of confusion has 6.4 to 9.6 pixels;
    the start is 30 % off in aperture and 15 % in focus distance, up or down by chance.
    """
    rng = np.random.default_rng(seed)
    place = room(seed, boxes=8)
    at = pose(rng.uniform(-3, 3), 0, rng.uniform(-0.3, 0.3, 3))
    image, depth, camera = seen(place, at, size, samples=4)
    focus = float(np.quantile(depth, rng.uniform(0.1, 0.9)))
    through = lambda aperture: ThinLens.from_camera(
        camera, aperture=aperture, focus_distance=focus
    )
    unit = float(through(1.0).circle_of_confusion(jnp.asarray(depth)).max())
    lens = through(8.0 * rng.uniform(0.8, 1.2) / unit)

    def render(eye):
        inverse = np.linalg.inv(np.asarray(eye.intrinsics, float))
        at = np.asarray(eye.world_from_camera, float)
        return cast(place, at, inverse, size, (0.5, 0.5))[0].astype(np.float32)

    passes = {"samples": samples, "seed": seed, "progress": False}
    photograph = np.asarray(dof.accumulate(render, camera, lens, **passes).image)
    up = rng.choice([-1, 1], 2)
    start = ThinLens(
        lens.aperture * (1 + 0.3 * up[0]),
        lens.focus_distance * (1 + 0.15 * up[1]),
        lens.focal_pixels,
    )
    return photograph, image, depth, lens, start
