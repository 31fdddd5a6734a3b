"""Materials and light from all around, beside Mitsuba's and beside rays.

`python -m benchmarks.relight_materials` prints three tables of `docs/relight.md`, in some two
minutes. It needs Mitsuba (the `bench` extra) and Embree (the `scene` extra).
"""

import numpy as np

from benchmarks.scenes import relight_mitsuba as mitsuba
from jaxfx import DirectionalLight, EnvironmentLight, GBuffer, relight, scene
from jaxfx.camera import Camera
from tests import test_environment as balls


COLOR = (0.9, 0.7, 0.5)
SUNS = {"before the ball": (0.5, 0.6, 1.0), "behind it": (1.0, 0.3, -0.5)}
# One radian about the vertical.
TURN = np.array([[0.5403, 0, 0.84147], [0, 1, 0], [-0.84147, 0, 0.5403]])


def print_suns() -> None:
    """A metal ball under one sun, by Mitsuba's materials."""
    print("| sun | roughness | glTF's, of Mitsuba's parts | `principled` | `roughconductor` |")
    print("|---|---:|---:|---:|---:|")
    for name, direction in SUNS.items():
        light = DirectionalLight(direction, [1, 1, 1])
        for roughness in (0.2, 0.5, 0.8):
            metal, normals, inside = balls.ball(1.0, roughness)
            white = GBuffer(**vars(metal) | {"specular": np.ones_like(metal.specular)})
            principled = {"base_color": mitsuba.rgb(COLOR), "metallic": 1.0}
            conductor = {"distribution": "ggx", "alpha": roughness**2, "material": "none"}
            pairs = (
                (metal, mitsuba.Gltf(COLOR, 1.0, roughness)),
                (metal, mitsuba.Own("principled", roughness=roughness, **principled)),
                (white, mitsuba.Own("roughconductor", **conductor)),
            )
            found = []
            for gbuffer, material in pairs:
                image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))[inside]
                truth = mitsuba.under_sun(material, direction, [1, 1, 1], normals, inside)
                found.append(f"{balls.psnr(image, np.pi * truth[inside]):.1f}")
            print(f"| {name} | {roughness} | {' | '.join(found)} |")


def print_surroundings() -> None:
    """Balls in surroundings, by Mitsuba's environment emitter."""
    print("| surroundings | Lambert | metal, roughness 0.2 | 0.5 | 0.8 |")
    print("|---|---:|---:|---:|---:|")
    for radiance, name in ((balls.clouds, "clouds"), (balls.lamps, "a window and a lamp")):
        light = EnvironmentLight(radiance(balls.directions(64)[0]), balls.TURN)
        emitter = mitsuba.surroundings(radiance, balls.TURN)
        found = []
        for roughness in (None, 0.2, 0.5, 0.8):
            gbuffer, normals, inside = balls.ball(
                float(roughness is not None), roughness or 1.0, 0 if roughness is None else 3
            )
            material = (
                mitsuba.Own("diffuse", reflectance=mitsuba.rgb(COLOR))
                if roughness is None
                else mitsuba.Gltf(COLOR, 1.0, roughness)
            )
            truth = mitsuba.in_surroundings(material, emitter, normals, inside)[inside]
            image = np.asarray(relight.shade(gbuffer, balls.CAMERA, light))[inside]
            found.append(f"{balls.psnr(image, truth):.1f}")
        print(f"| {name} | {' | '.join(found)} |")


def traced(room: scene.Scene, gbuffer: GBuffer, camera: Camera, light: EnvironmentLight):
    """The diffuse image by a ray in the direction of every texel of a picture."""
    picture = np.asarray(light.pyramid)[: 2 * light.heights[0] ** 2]
    way, solid_angle = (
        part.reshape(-1, *part.shape[2:]) for part in balls.directions(light.heights[0])
    )
    way = way @ np.asarray(light.world_from_image).T
    points = np.asarray(camera.points(np.asarray(gbuffer.depth, float)))
    image = np.zeros((*gbuffer.depth.shape, 3))
    for j, i in np.argwhere(np.isfinite(gbuffer.depth)):
        cosine = np.maximum(way @ np.asarray(gbuffer.normal[j, i], float), 0)
        end = points[j, i] + 4 * room.radius * way
        is_free = np.asarray(scene.visible(room, points[j, i], end))
        weights = cosine * solid_angle * is_free / np.pi
        image[j, i] = np.asarray(gbuffer.diffuse[j, i]) * (weights @ picture)
    return image


def print_shadows(height: int = 24, width: int = 32, rows: int = 32) -> None:
    """The matt still life in the shadow of itself, by rays to all texels."""
    room = scene.still_life()
    camera = scene.default_camera(room, height=height, width=width)
    gbuffer = scene.gbuffer(room, camera, height=height, width=width, backend="embree")
    gbuffer = GBuffer(**vars(gbuffer) | {"shader": np.minimum(gbuffer.shader, 0)})
    trace = lambda **options: scene.occlusion(room, gbuffer, camera, **options)
    nine, sixteen = (trace(ray_count=1024, degree=degree) for degree in (2, 3))
    shadows = {
        "none": None,
        "one number": np.clip(nine[..., 0] * np.sqrt(4 * np.pi), 0, 1),
        "9": nine,
        "16": sixteen,
        "16, of 64 rays": trace(ray_count=64),
        "16, of 16 rays": trace(ray_count=16),
    }
    print(f"| surroundings | {' | '.join(shadows)} |\n|---|{len(shadows) * '---:|'}")
    for radiance, name in (
        (balls.clouds, "clouds"),
        (balls.lamps, "a window and a lamp"),
        (balls.sun, "a sun in an even sky"),
    ):
        whole = EnvironmentLight(radiance(balls.directions(rows)[0]))
        for turn, how in ((np.eye(3), ""), (TURN, ", turned")):
            light = whole.turned(turn)
            truth = traced(room, gbuffer, camera, light)
            images = (relight.shade(gbuffer, camera, light, v) for v in shadows.values())
            found = (f"{balls.psnr(np.asarray(image), truth):.1f}" for image in images)
            print(f"| {name}{how} | {' | '.join(found)} |")


def main() -> None:
    print_suns()
    print()
    print_surroundings()
    print()
    print_shadows()


if __name__ == "__main__":
    main()
