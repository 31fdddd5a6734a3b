"""Random shadow maps, and scenes with reference shadows: analytic, or traced by Embree."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    OrthographicCamera,
    PinholeCamera,
    SpotLight,
    relight,
    scene,
    shadow,
)
from jaxfx._sampling import pixel_centers


WHITE = [1.0, 1.0, 1.0]

# `two_discs`: the texels per pixel, in a view rotated against the map; the floor's depth. The
# discs shrink for larger filters, so that 3 to 5 % of the pixels lie in a penumbra.
STEP, FLOOR = 0.9, 5.0


def steps(seed: int, dtype: Any = np.float32) -> tuple[np.ndarray, shadow.Receivers]:
    """A map of flat blocks and a few single texels, so that some filter windows are uniform."""
    rng = np.random.default_rng(seed)
    shadow_map = np.repeat(np.repeat(rng.choice([1.0, 2.0, np.inf], (4, 5)), 16, 0), 16, 1)
    shadow_map[rng.integers(0, 64, 5), rng.integers(0, 80, 5)] = rng.uniform(0.5, 3, 5)
    u, v = (rng.uniform(-6, count + 6, (40, 50)) for count in (80, 64))
    z = rng.choice([-1.0, 1.0, 1.5, 2.0, 2.5, np.nan, np.inf], (40, 50))
    fields = (u, v, z, rng.uniform(0, 0.2, (40, 50)))
    return shadow_map.astype(dtype), shadow.Receivers(*(jnp.asarray(f, dtype) for f in fields))


def noise(
    seed: int = 0,
    map_shape: tuple[int, int] = (14, 17),
    shape: tuple[int, int] = (9, 11),
    dtype: Any = np.float64,
) -> tuple[np.ndarray, shadow.Receivers]:
    """A random map with background, and receivers inside, outside, and behind the light."""
    rng = np.random.default_rng(seed)
    shadow_map = rng.uniform(1, 3, map_shape)
    shadow_map[rng.uniform(size=map_shape) < 0.1] = np.inf
    u, v = (rng.uniform(-4, count + 4, shape) for count in map_shape[::-1])
    z = rng.uniform(1, 3, shape)
    z[rng.uniform(size=shape) < 0.1] = -1
    fields = (u, v, z, rng.uniform(0, 0.2, shape))
    return shadow_map.astype(dtype), shadow.Receivers(*(f.astype(dtype) for f in fields))


def two_discs(size, side=512):
    """A map of two discs above a floor, and the receivers' fields, in float32 NumPy."""
    y, x = np.mgrid[:side, :side] + 0.5
    shadow_map = np.full((side, side), FLOOR)
    for cx, cy, radius, depth in ((0.3, 0.35, 460, 2.0), (0.68, 0.62, 560, 3.0)):
        inside = (x - cx * side) ** 2 + (y - cy * side) ** 2 < (radius / size) ** 2
        shadow_map[inside] = depth
    turn = STEP * np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    u, v = np.einsum("ab,bji->aji", turn, np.stack([x, y]) - side / 2) + side / 2
    fields = (u, v, np.full_like(u, FLOOR), 0 * u)
    return shadow_map.astype(np.float32), [field.astype(np.float32) for field in fields]


def plate(magnification, width, side=96, texels=64):
    """A plate of `width` texels at depth 2 above a floor at 4.

    A texel is `magnification` pixels wide.
    """
    shadow_map = np.full((texels, texels), 5.0)
    first = (texels - width) // 2
    shadow_map[:, first : first + width] = 2.0
    x = (np.arange(side) + 0.5 - side / 2) / magnification + texels / 2
    u, v = np.meshgrid(x, x)
    return shadow_map, shadow.Receivers(*map(jnp.asarray, (u, v, np.full_like(u, 4.0), 0 * u)))


def slats(side: int = 96) -> tuple[np.ndarray, shadow.Receivers]:
    """Occluders over one another above a floor at depth 4, and receivers on all of it.

    Slats at 1 above a table at 3 that covers the left half; below, slats at 2 about an edge,
    behind which the map sees 9.
    """
    y, x = np.mgrid[:side, :side] + 0.5
    shadow_map = np.where(x < side / 2, 3.0, 4.0)
    shadow_map[(x // 12 % 2 == 0) & (y < 0.6 * side)] = 1.0
    below = np.where(x // 8 % 2 == 0, 2.0, 9.0)
    shadow_map = np.where(y > 0.8 * side, below, shadow_map).astype(np.float32)
    fields = (x + 0.3, y + 0.2, np.full_like(x, 4.0), 0 * x)
    return shadow_map, shadow.Receivers(*(jnp.asarray(f, jnp.float32) for f in fields))


class Still:
    """A view of the still life: its depth, normals and points, and rays traced from these."""

    sun = np.array([0.6, -0.67, -0.42])
    lamp, target = np.array([-1.2, 2.6, -1.6]), np.array([0.0, 0.4, -3.8])

    def __init__(self, side=96):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.side, self.mesh = side, scene.still_life()
        self.eye = scene.default_camera(self.mesh, height=side, width=side)
        gbuffer = scene.gbuffer(self.mesh, self.eye, height=side, width=side, backend="embree")
        self.depth, self.normal = gbuffer.depth, gbuffer.normal
        centers = pixel_centers(side, side, gbuffer.depth.dtype)
        self.points = np.asarray(self.eye.unproject(centers, gbuffer.depth), np.float64)
        self.rays = EmbreeScene(robust=True)
        TriangleMesh(self.rays, self.mesh.vertices[self.mesh.faces].astype(np.float32))

    def truth(self, towards, distance=np.inf):
        """Which points see the light in direction `towards`, and which face it clearly."""
        towards = np.broadcast_to(towards, self.points.shape)
        towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
        normal = np.asarray(self.normal, np.float64)
        rays = (self.points + 1e-3 * normal, towards)
        rays = (np.ascontiguousarray(each.reshape(-1, 3), np.float32) for each in rays)
        first = self.rays.run(*rays, query="DISTANCE").reshape(self.side, self.side)
        clear = first > 1e30 if np.isinf(distance).all() else first > distance
        return clear, np.sum(normal * towards, axis=-1) > 0.05

    def from_position(self, position):
        """As `truth`, for a light at a position."""
        towards = position - self.points
        return self.truth(towards, np.linalg.norm(towards, axis=-1))

    def compared(self, cameras, map_size):
        """The cameras' shadow maps side by side, and the receivers."""
        options = {"height": map_size, "width": map_size, "backend": "embree"}
        maps = [np.asarray(scene.depth(self.mesh, camera, **options)) for camera in cameras]
        seen = shadow.receivers(self.depth, self.eye, cameras, normal=self.normal)
        return np.concatenate(maps, axis=1), seen

    def under_the_sun(self, map_size):
        ends = self.points.reshape(-1, 3)
        centre = (ends.min(axis=0) + ends.max(axis=0)) / 2
        radius = np.linalg.norm(ends - centre, axis=-1).max()
        light = DirectionalLight(self.sun, WHITE)
        cameras = shadow.light_cameras(
            light, map_size=map_size, scene_center=centre, scene_radius=radius
        )
        return self.compared(cameras, map_size)

    def under_a_square_lamp(self, map_size, light_size):
        """The lamp's camera, map and receivers, the visibility by 36 rays, and the penumbra."""
        light = SpotLight(self.lamp, self.target - self.lamp, WHITE, 0.7, 0.9)
        (camera,) = shadow.light_cameras(light, map_size=map_size)
        right, down = light_size * np.asarray(camera.world_from_camera, np.float64)[:3, :2].T
        steps = (np.arange(6) + 0.5) / 6 - 0.5
        rays = [
            self.from_position(self.lamp + a * right + b * down) for a in steps for b in steps
        ]
        clear, facing = (np.array(each) for each in zip(*rays, strict=True))
        share, data = clear.mean(axis=0), self.compared((camera,), map_size)
        far = np.abs(np.stack(data[1][:2]) - map_size / 2) < 0.47 * map_size
        inside = facing.all(axis=0) & far.all(axis=0) & (data[1].z > 0)
        return camera, data, share, inside & (share > 0) & (share < 1)


def acne_and_leaks(visible, clear, facing):
    """The fraction of lit points that are shown dark, and of dark points that are shown lit."""
    visible = np.asarray(visible)
    return np.mean(visible[facing & clear] == 0), np.mean(visible[facing & ~clear] == 1)


class Boxes:
    """Boxes on a floor, seen from above.

    All visible faces are horizontal and so equally bright: only shadows tell where the sun is.
    """

    bounds = np.array(
        [
            [[-3.0, -0.2, -3.0], [3.0, 0.0, 3.0]],
            [[-0.15, 0.0, -0.15], [0.15, 1.2, 0.15]],
            [[-1.2, 0.0, 0.3], [-0.7, 0.5, 1.0]],
            [[0.6, 0.0, -1.1], [1.3, 0.3, -0.9]],
        ]
    )
    up = np.array([0.0, 1.0, 0.0])
    sun = np.array([0.6, -1.0, 0.35]) / np.linalg.norm([0.6, -1.0, 0.35])
    # Texels per scene unit in each round of a search; shadows are softened over one texel.
    scales = (8.0, 16.0, 32.0, 64.0)

    def __init__(self, side=64, map_size=160):
        self.size, self.map_size = {"height": side, "width": side}, map_size
        parts = [trimesh.creation.box(bounds=bounds) for bounds in self.bounds]
        self.mesh = scene.from_trimesh(trimesh.util.concatenate(parts))
        pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, 5], [0, 1, 0, 0], [0, 0, 0, 1]])
        self.eye = OrthographicCamera(side / 5, jnp.array([side / 2, side / 2]), pose)
        self.gbuffer = scene.gbuffer(self.mesh, self.eye, **self.size)

    def in_sun(self, direction):
        """The sun's visibility per pixel, 0 or 1, by the slab test against each box."""
        depth = jnp.asarray(self.gbuffer.depth, float)
        points = np.asarray(self.eye.unproject(pixel_centers(**self.size), depth))
        points = points + 1e-4 * self.up
        clear = np.ones(points.shape[:-1], bool)
        for low, high in self.bounds:
            one, other = (low - points) / -direction, (high - points) / -direction
            enter, leave = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
            clear &= (leave < 1e-6) | (leave < enter)
        return clear.astype(float)

    def photograph(self):
        """The image under a sun and a sky, with hard shadows."""
        sky, sun = AmbientLight([0.2, 0.25, 0.3]), DirectionalLight(self.sun, [2.0, 1.8, 1.5])
        image = relight.shade(self.gbuffer, self.eye, sky)
        return image + relight.shade(self.gbuffer, self.eye, sun, self.in_sun(self.sun))

    def turned(self, angle, about):
        """The sun's direction rotated by `angle`, about an axis given by the angle `about`."""
        across = np.cross(self.sun, self.up) / np.linalg.norm(np.cross(self.sun, self.up))
        side = np.cos(about) * across + np.sin(about) * np.cross(self.sun, across)
        return np.cos(angle) * self.sun + np.sin(angle) * side

    def miss(self, light):
        """The angle between a light and the sun, in degrees."""
        length = np.linalg.norm(light.direction)
        return float(np.degrees(np.arccos(np.clip(self.sun @ light.direction / length, -1, 1))))

    def seen_from(self, direction, scale):
        """The shadow map of a sun, and its camera."""
        size = {"height": self.map_size, "width": self.map_size}
        centre = jnp.array([self.map_size / 2, self.map_size / 2])
        eye = -8 * np.asarray(direction)
        look = PinholeCamera.look_at(eye, np.zeros(3), up=[0, 1, 0], fov_y=1.0, **size)
        camera = OrthographicCamera(scale, centre, look.world_from_camera)
        return scene.depth(self.mesh, camera, **size), camera

    def shadows(self, lights, index):
        """The shadows for round `index` of `fit.lights`, of the sun as estimated."""
        scale = self.scales[index]
        seen = self.seen_from(lights[1].direction, scale)
        return None, shadow.MovingShadow(*seen, self.gbuffer, self.eye, softness=1 / scale)
