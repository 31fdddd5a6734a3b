"""A ball of one material by Mitsuba, a path tracer: its own materials, lights and surroundings.

The ball is that of `tests/test_environment.py`: at z = 3, of radius 1, seen along z through the
centres of the pixels. So the images are not antialiased, like a G-buffer.
"""

import mitsuba as mi
import numpy as np


if not mi.variant():
    mi.set_variant("scalar_rgb")

_CENTER = np.array([0.0, 0, 3])


def rgb(color):
    return {"type": "rgb", "value": np.asarray(color, float).tolist()}


class Own:
    """One of Mitsuba's materials, by the name of its plugin."""

    def __init__(self, plugin, **options):
        self.material = mi.load_dict({"type": plugin, **options})
        self.context = mi.BSDFContext()

    def value(self, hit, way):
        """The reflectance per solid angle towards `way`, times its cosine."""
        return np.array(self.material.eval(self.context, hit, way))

    def sampled(self, hit, square):
        """A direction, chosen by a point of a square, and the share of its light."""
        sample, share = self.material.sample(self.context, hit, 0.5, square)
        return sample.wo, np.array(share)


class Gltf:
    """glTF's material of Mitsuba's own parts: its GGX, and of its Smith term of one direction
    the height-correlated term of two (Heitz 2014, equation 99)."""

    def __init__(self, color, metallic, roughness):
        base = np.asarray(color, float)
        self.diffuse, self.f0 = base * (1 - metallic), 0.04 * (1 - metallic) + base * metallic
        # Its last argument: sample those normals that are seen.
        self.normals = mi.MicrofacetDistribution(
            mi.MicrofacetType.GGX, float(roughness**2), True
        )

    def _parts(self, hit, way, halfway):
        """Fresnel's term, and Smith's of the camera and of both directions."""
        seen = self.normals.smith_g1(hit.wi, halfway)
        lit = self.normals.smith_g1(way, halfway)
        cosine = float(np.dot(np.array(hit.wi), np.array(halfway)))
        fresnel = self.f0 + (1 - self.f0) * (1 - cosine) ** 5
        return fresnel, seen, 1 / (1 / seen + 1 / lit - 1) if min(seen, lit) > 0 else 0

    def value(self, hit, way):
        if way.z <= 0:
            return np.zeros(3)
        halfway = np.array(hit.wi) + np.array(way)
        halfway = mi.Vector3f((halfway / np.linalg.norm(halfway)).tolist())
        fresnel, _, both = self._parts(hit, way, halfway)
        lobe = self.normals.eval(halfway) * both / (4 * hit.wi.z)
        return (1 - fresnel) * self.diffuse / np.pi * way.z + fresnel * lobe

    def sampled(self, hit, square):
        """Of the highlight alone."""
        halfway, _ = self.normals.sample(hit.wi, square)
        m, v = np.array(halfway), np.array(hit.wi)
        way = mi.Vector3f((2 * (m @ v) * m - v).tolist())
        if way.z <= 0:
            return way, np.zeros(3)
        fresnel, seen, both = self._parts(hit, way, mi.Vector3f(halfway))
        return way, fresnel * both / seen


def _hits(world, normals, inside):
    """Where rays along z meet the ball, for each pixel that shows it."""
    for j, i in np.argwhere(inside):
        start = _CENTER + normals[j, i]
        ray = mi.RayDifferential3f(mi.Ray3f([start[0], start[1], 0.0], [0.0, 0, 1]))
        yield j, i, world.ray_intersect(ray)


def _world(light):
    ball = {"type": "sphere", "center": _CENTER.tolist(), "radius": 1.0}
    return mi.load_dict({"type": "scene", "ball": ball, "light": light})


def under_sun(material, direction, color, normals, inside):
    """The image under a sun, of irradiance `color`."""
    light = np.asarray(direction, float) / np.linalg.norm(direction)
    world = _world(
        {"type": "directional", "direction": light.tolist(), "irradiance": rgb(color)}
    )
    image = np.zeros((*inside.shape, 3))
    for j, i, hit in _hits(world, normals, inside):
        sample, irradiance = world.sample_emitter_direction(hit, [0.5, 0.5], False)
        way = hit.to_local(sample.d)
        image[j, i] = material.value(hit, way) * np.array(irradiance)
    return image


def surroundings(radiance, turn, height=512):
    """An environment emitter of a function of the direction.

    Mitsuba's first row lies at a pole and its last at the other; its first column looks along
    -z, where this package's middle one does.
    """
    row, column = np.mgrid[:height, : 2 * height]
    above, right = np.pi * (0.5 - row / (height - 1)), np.pi * (column + 0.5) / height
    way = [np.cos(above) * np.sin(right), np.sin(above), -np.cos(above) * np.cos(right)]
    pose = np.eye(4)
    pose[:3, :3] = turn
    picture = radiance(np.stack(way, axis=-1)).astype(np.float32)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(picture)),
        "to_world": mi.ScalarTransform4f(pose.tolist()),
    }


def in_surroundings(material, emitter, normals, inside, side=32):
    """The image in `surroundings`, nothing in shadow: `side` x `side` even samples a pixel."""
    world = _world(emitter)
    sky, image = world.environment(), np.zeros((*inside.shape, 3))
    squares = ((np.indices((side, side)).reshape(2, -1).T + 0.5) / side).tolist()
    away = mi.SurfaceInteraction3f()
    for j, i, hit in _hits(world, normals, inside):
        for square in squares:
            way, share = material.sampled(hit, square)
            if share.any():
                away.wi = -hit.to_world(way)
                image[j, i] += share * np.array(sky.eval(away))
    return image / side**2
