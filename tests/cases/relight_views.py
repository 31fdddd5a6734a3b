"""Caches of planes and of the still life, and single pixels, whose images are known."""

from typing import Any

import equinox as eqx
import numpy as np

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    PinholeCamera,
    PointLight,
    SpotLight,
    scene,
)


SIZE = HEIGHT, WIDTH = 24, 32
REFLECTANCES = ("color", "ambient", "diffuse", "specular")

# Single pixels, seen by a camera at the origin whose only pixel looks along z.

FRONT = PinholeCamera([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], np.eye(4))


def one_pixel(shader=0, *, normal=(0, 0, -1), depth=1.0, roughness=0.5):
    """A grey pixel on the axis of `FRONT`, at (0, 0, depth)."""
    fields = zip(REFLECTANCES, (1, 0.1, 0.5, 0.25), strict=True)
    return GBuffer(
        **{name: np.full((1, 1, 3), float(value)) for name, value in fields},
        shader=np.full((1, 1), shader),
        normal=np.full((1, 1, 3), normal, float),
        depth=np.full((1, 1), float(depth)),
        roughness=np.full((1, 1), float(roughness)),
    )


def sun(*direction):
    return DirectionalLight(direction, [4, 8, 12])


SLANTED = (np.sqrt(0.75), 0, 0.5)  # Sixty degrees off the axis.
LAMP = PointLight([0, 0, 0], [4, 8, 12])
AHEAD = SpotLight([0, 0, 0], [0, 0, 1], [4, 8, 12], 0, 1)
CLOSED = eqx.tree_at(lambda spot: spot.outer_angle, AHEAD, AHEAD.inner_angle)

# What a light gives, times its colour. n = 6: of Phong's angle of 60 degrees the cosine to the
# sixth is 1 / 64; Blinn's is 30.
BY_HAND: dict[str, list[tuple[GBuffer, Any, float]]] = {
    "Lambert": [
        (one_pixel(), AmbientLight([4, 8, 12]), 0.1),
        (one_pixel(), sun(0, 0, 5), 0.5),
        (one_pixel(), sun(*SLANTED), 0.25),
        (one_pixel(), sun(0, 0, -1), 0),
        # Twice as far, a quarter.
        (one_pixel(depth=2), LAMP, 0.5 / 4),
        # A cone whose border goes from 0 to 90 degrees: at 60, s is 1 / 2.
        (one_pixel(), SpotLight([0, 0, 0], SLANTED, [4, 8, 12], 0, np.pi / 2), 0.25),
        (one_pixel(), SpotLight([0, 0, 0], [1, 0, 1], [4, 8, 12], 0.8, 0.9), 0.5),
        (one_pixel(), SpotLight([0, 0, 0], [1, 0, 1], [4, 8, 12], 0.6, 0.7), 0),
        (one_pixel(), CLOSED, 0),
    ],
    "Phong": [
        # The lamp is at the eye, so the highlight is full.
        (one_pixel(1, depth=2), LAMP, 0.75 / 4),
        (one_pixel(1), sun(*SLANTED), 0.25 + 0.25 / 64),
        (one_pixel(1, roughness=0), LAMP, 0.75),
        (one_pixel(1, roughness=0), sun(*SLANTED), 0.25),
        (one_pixel(1, normal=(0, 0, 0)), LAMP, 0),
        (one_pixel(1, normal=(0, 0, 1)), LAMP, 0),
    ],
    "Blinn": [
        (one_pixel(2, depth=2), LAMP, 0.75 / 4),
        (one_pixel(2), sun(*SLANTED), 0.25 + 0.25 * 27 / 64),
        # Light against the view has no direction halfway.
        (one_pixel(2, normal=(0, 0, 1)), sun(0, 0, -1), 0.5),
        (one_pixel(2, roughness=0), LAMP, 0.75),
        (one_pixel(2, roughness=0), sun(*SLANTED), 0.25),
        # The length of a normal, which a file may round, is not brightness.
        (one_pixel(2, normal=(0, 0, -1.01)), LAMP, 0.75),
        (one_pixel(2, depth=np.inf), LAMP, 0),
    ],
    "background": [
        (one_pixel(-1, depth=np.inf), AmbientLight([4, 8, 12]), 0),
        (one_pixel(-1), AmbientLight([np.inf] * 3), 0),
    ],
}

DEGENERATE: dict[str, tuple[GBuffer, Any]] = {
    "light in the surface's plane": (one_pixel(1), sun(1, 0, 0)),
    "mirror image across the view": (
        one_pixel(1, normal=(np.sqrt(0.5), 0, -np.sqrt(0.5)), roughness=0.9),
        sun(0, 0, 1),
    ),
    "light against the view": (one_pixel(2), sun(0, 0, -1)),
    "light against the view, seen": (one_pixel(2, normal=(0, 0, 1)), sun(0, 0, -1)),
    "roughness 0 at the peak": (one_pixel(2, roughness=0), LAMP),
    "roughness 0 off the peak": (one_pixel(1, roughness=0), sun(*SLANTED)),
    "roughness 1e-6": (one_pixel(2, roughness=1e-6), PointLight([1e-7, 0, 0], [1, 1, 1])),
    "roughness 1": (one_pixel(1, roughness=1), sun(*SLANTED)),
    "light at the surface": (one_pixel(2), PointLight([0, 0, 1], [1, 1, 1])),
    "light just off it": (one_pixel(1), PointLight([0, 0, 1 - 1e-6], [1, 1, 1])),
    "spot at the surface": (one_pixel(1), SpotLight([0, 0, 1], [0, 0, 1], [1, 1, 1], 0, 1)),
    "spot on its axis": (one_pixel(1), AHEAD),
    "spot turned away": (one_pixel(1), SpotLight([0, 0, 0], [0, 0, -1], [1, 1, 1], 0, np.pi)),
    "spot that closes": (one_pixel(1), CLOSED),
    "zero normal": (one_pixel(1, normal=(0, 0, 0)), LAMP),
    "background": (one_pixel(-1, normal=(0, 0, 0), depth=np.inf, roughness=0), LAMP),
    "a surface infinitely far": (one_pixel(2, depth=np.inf), LAMP),
}

# Views of the still life.

MESH = scene.still_life()
CENTRE = np.array(MESH.viewpoint.at)
EYE = np.array(MESH.viewpoint.eye)


def orbit(degrees, raised=0.0, size=SIZE):
    """A camera about the still life's centre, turned to the side and raised."""
    angle = np.radians(degrees)
    turn = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    eye = CENTRE + turn @ (EYE - CENTRE) + [0, raised, 0]
    size = {"height": size[0], "width": size[1]}
    return PinholeCamera.look_at(eye, CENTRE, up=[0, 1, 0], fov_y=0.8, **size)


def cache(camera, size=SIZE):
    return scene.gbuffer(MESH, camera, height=size[0], width=size[1], backend="embree")


LARGE = (96, 128)
# Of `orbit`: degrees to the side, and scene units upwards.
AROUND = [
    (-6, 0.0),
    (6, 0.0),
    (0, 0.25),
    (0, -0.2),
    (-14, 0.1),
    (14, 0.1),
    (-10, 0.4),
    (10, 0.4),
]


# Planes.


def points(camera, depth):
    """The world's points that a camera sees at a depth, in NumPy."""
    rows, columns = np.indices(np.shape(depth)) + 0.5
    pixels = np.stack([columns, rows], axis=-1)
    return np.asarray(camera.unproject(pixels, depth))


def plane(normal, *, size=SIZE, shader=0, offset=0.0):
    """Caches of a plane through (0, 0, 3), in closed form; its colours are the camera's own."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)

    def of(camera, color=None):
        rng = np.random.default_rng([*np.asarray(camera.world_from_camera).tobytes()])
        near, far = (points(camera, np.full(size, depth)) for depth in (1.0, 2.0))
        rate = (far - near) @ normal
        depth = 1 + (np.array([0, 0, 3.0 + offset]) - near) @ normal / rate
        image = rng.uniform(0.2, 1, (*size, 3)) if color is None else np.full((*size, 3), color)
        facing = normal * -np.sign(rate)[..., None]
        return GBuffer(
            *(image, np.full(size, shader), image, image, image, facing),
            depth=np.where(depth > 0, depth, np.inf),
            roughness=image[..., 0],
        )

    return of


def pinhole(x=0.0, y=0.0):
    return PinholeCamera.look_at(
        [x, y, 0], [0, 0, 3], up=[0, -1, 0], fov_y=0.7, height=HEIGHT, width=WIDTH
    )


FRONTAL = plane([0, 0, -1])
CAMERAS = [pinhole(-0.4), pinhole(0.3, 0.2), pinhole(0.1, -0.3)]
TARGET = pinhole(0.05, 0.04)
RED, BLUE = np.array([0.9, 0.1, 0.1]), np.array([0.1, 0.1, 0.9])
