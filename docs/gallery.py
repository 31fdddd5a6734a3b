"""Make the images of the documentation's front page and of its sliders.

    python docs/gallery.py

Writes JPEGs to `docs/gallery`: six images of one scene, an effect each, and two series of
frames (`focus_*`, `light_*`) for the sliders of the guides.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image
from tqdm.auto import tqdm

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    PointLight,
    SpotLight,
    ThinLens,
    dof,
    io,
    relight,
    reproject,
    scene,
    shadow,
)


OUT = Path(__file__).parent / "gallery"
HEIGHT, WIDTH = 240, 320
FRAMES = 13
# Scene units: of the still life, whose objects are 2 to 5 away.
APERTURE, FOCUS = 0.12, 2.6
# Everything beyond this depth is the wall.
WALL = 4.5


def write(name: str, image) -> None:
    """An image in linear light, as JPEG."""
    screen = np.rint(255 * io.srgb_from_linear(np.clip(np.asarray(image), 0, 1)))
    Image.fromarray(screen.astype(np.uint8)).save(OUT / f"{name}.jpg", quality=82)


def main() -> None:
    """Make all images."""
    OUT.mkdir(exist_ok=True)
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=HEIGHT, width=WIDTH)
    view = {"height": HEIGHT, "width": WIDTH}
    gbuffer = scene.gbuffer(mesh, camera, **view)
    lights = scene.default_lights(camera)
    image = relight.render(gbuffer, camera, lights)
    depth = gbuffer.depth
    behind_gbuffer = scene.gbuffer(mesh, camera, layer_index=1, **view)
    behind = relight.render(behind_gbuffer, camera, lights), behind_gbuffer.depth
    lens = ThinLens.from_camera(camera, aperture=APERTURE, focus_distance=FOCUS)

    write("pinhole", image)
    write("depth_of_field", dof.layered(image, depth, lens, behind=behind))

    # Lights of 50 x white on the wall take the shape of the iris.
    rng = np.random.default_rng(3)
    lamps = np.array(image)
    wall = np.argwhere(np.asarray(depth)[: HEIGHT // 3] > WALL)
    rows, columns = rng.choice(wall, 30, replace=False).T
    lamps[rows, columns] = 50 * (0.3 + 0.7 * rng.random((30, 3)))
    iris = dof.Iris(blades=6, rotation=0.3)
    wide = ThinLens.from_camera(camera, aperture=2 * APERTURE, focus_distance=FOCUS)
    write("highlights", dof.layered(lamps, depth, wide, iris=iris))

    angle = np.deg2rad(2.5)
    turn = np.eye(4)
    turn[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    pivot = np.eye(4)
    pivot[2, 3] = 2.5
    pose = jnp.asarray(
        np.asarray(camera.world_from_camera) @ pivot @ turn @ np.linalg.inv(pivot)
    )
    target = type(camera)(camera.intrinsics, pose.astype(jnp.float32))
    warped, alpha = reproject.warp(image, depth, camera, target)
    write("new_view", np.asarray(warped) + 0.5 * (1 - np.asarray(alpha))[..., None])

    eye = np.asarray(camera.world_from_camera)
    center = eye[:3, 3] + 3.2 * eye[:3, 2]

    def lamp(turn_degrees):
        """A spot light above the scene, its position turned about the vertical."""
        turn = np.deg2rad(turn_degrees)
        side = np.cos(turn) * eye[:3, 0] - np.sin(turn) * eye[:3, 2]
        position = center + 3.0 * side - 4.0 * eye[:3, 1]
        return SpotLight(
            position=position.astype(np.float32),
            direction=(center - position).astype(np.float32),
            color=np.full(3, 48.0, np.float32),
            outer_angle=1.0,
            inner_angle=0.6,
        )

    def lit(light):
        (light_camera,) = shadow.light_cameras(light, map_size=512)
        shadow_map = scene.depth(mesh, light_camera, height=512, width=512)
        receivers = shadow.receivers(depth, camera, light_camera)
        visibility = shadow.pcss(
            shadow_map, receivers, light_camera=light_camera, light_size=0.3, size=15
        )
        fill = DirectionalLight(direction=eye[:3, 2], color=jnp.full(3, 0.22))
        ambient = AmbientLight(color=jnp.full(3, 0.08))
        every = [light, fill, ambient]
        return relight.render(gbuffer, camera, every, visibilities=[visibility, None, None])

    def lamps_of(hues):
        """Point lights of these colours, evenly around the scene."""
        turns = np.linspace(0, np.pi, len(hues))
        sides = [np.cos(t) * eye[:3, 0] - np.sin(t) * eye[:3, 2] for t in turns]
        places = [center + 2.5 * side - 1.5 * eye[:3, 1] for side in sides]
        return [
            PointLight(position=place.astype(np.float32), color=np.array(hue, np.float32))
            for place, hue in zip(places, hues, strict=True)
        ]

    colored = lamps_of([(22, 5, 3), (5, 8, 5), (3, 6, 24)])
    ambient = AmbientLight(color=jnp.full(3, 0.1))
    write("relighting", relight.render(gbuffer, camera, [*colored, ambient]))

    write("shadows", lit(lamp(40.0)))
    for k, degrees in enumerate(tqdm(np.linspace(0, 180, FRAMES), desc="lights")):
        write(f"light_{k:02}", lit(lamp(degrees)))
    for k, distance in enumerate(tqdm(1 / np.linspace(1 / 5.5, 1 / 2.0, FRAMES), desc="focus")):
        wide = ThinLens.from_camera(camera, aperture=APERTURE, focus_distance=float(distance))
        write(f"focus_{k:02}", dof.layered(image, depth, wide, behind=behind, max_coc=40))


if __name__ == "__main__":
    main()
