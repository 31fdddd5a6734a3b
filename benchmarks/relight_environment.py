"""A still life of glTF's materials in surroundings that turn, and a table of planned views.

`python -m benchmarks.relight_environment --out docs` writes `relight_environment.jpg` and
prints the table of `docs/relight.md`, in a minute.
"""

import argparse
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from PIL import Image

from benchmarks.scenes.relight import about_y, still_life, surroundings
from jaxfx import EnvironmentLight, GBuffer, PinholeCamera, io, relight, scene


SIZE = {"height": 216, "width": 288}
TURNS = (0, 120, 240)


def balls() -> tuple[GBuffer, PinholeCamera]:
    """Balls in two rows: gold above, a red dielectric below, roughness from 0.1 to 0.9."""
    import trimesh

    content = trimesh.Scene()
    for row, (color, metal) in enumerate(
        (([255, 190, 80, 255], 1.0), ([200, 30, 20, 255], 0.0))
    ):
        for column, roughness in enumerate((0.1, 0.3, 0.5, 0.7, 0.9)):
            ball = trimesh.creation.icosphere(4)
            ball.vertex_normals = ball.vertices
            material = trimesh.visual.material.PBRMaterial(
                baseColorFactor=color, metallicFactor=metal, roughnessFactor=roughness
            )
            ball.visual = trimesh.visual.TextureVisuals(
                uv=np.zeros((len(ball.vertices), 2)), material=material
            )
            ball.apply_translation([2.3 * (column - 2), 2.3 * (0.5 - row), 0])
            content.add_geometry(ball)
    camera = PinholeCamera.look_at([0, 0, 14], [0, 0, 0], up=[0, 1, 0], fov_y=0.6, **SIZE)
    return scene.gbuffer(scene.from_trimesh(content), camera, **SIZE), camera


def pictures() -> dict[str, np.ndarray]:
    """The images by title; to turn the surroundings is one edit of one light."""
    light, found = EnvironmentLight(surroundings()), {}
    room = still_life()
    camera = scene.default_camera(room, **SIZE)
    views = (
        ("", scene.gbuffer(room, camera, **SIZE), camera),
        (", roughness 0.1 to 0.9", *balls()),
    )
    for name, gbuffer, camera in views:
        state = relight.start(gbuffer, camera, [light])
        for degrees in TURNS:
            image = state.edit(0, light.turned(about_y(degrees))).image
            found[f"turned by {degrees} degrees{name}"] = np.asarray(image)
    return found


def write(images: dict[str, np.ndarray], path: Path) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(10.5, 5.6), layout="constrained")
    for ax, (title, image) in zip(axes.flat, images.items(), strict=True):
        ax.imshow(io.srgb_from_linear(np.clip(image, 0, 1)))
        ax.set_title(title, fontsize=9)
        ax.set_axis_off()
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=80)
    Image.open(stream).convert("RGB").save(path, quality=60, optimize=True)


def print_plans() -> None:
    """The share of what a path sees that planned cameras see, beside evenly spaced ones."""
    room, size = scene.still_life(), {"height": 48, "width": 64}
    at, eye = np.array(room.viewpoint.at), np.array(room.viewpoint.eye)
    turns = [about_y(degrees) for degrees in np.linspace(-40, 40, 17)]
    path = [
        PinholeCamera.look_at(at + turn @ (eye - at), at, up=[0, 1, 0], fov_y=0.8, **size)
        for turn in turns
    ]
    print("| cameras | planned | evenly spaced |\n|---:|---:|---:|")
    for count in (1, 2, 3, 4, 6):
        planned = scene.plan_views(room, path, count=count, **size).covered[-1]
        # In the middle of as many equal parts of the path.
        steps = np.round((np.arange(count) + 0.5) / count * len(path) - 0.5).astype(int)
        some = [path[step] for step in steps]
        even = scene.plan_views(room, path, candidates=some, count=count, **size).covered[-1]
        print(f"| {count} | {100 * planned:.1f} % | {100 * even:.1f} % |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    write(pictures(), out / "relight_environment.jpg")
    print_plans()


if __name__ == "__main__":
    main()
