"""Views around a scene from one image with its depth.

Renders a mesh, or reads an image and its depth from an EXR file, and turns the camera about the
median depth by reprojecting that single image. Holes, which the image does not show, are
hatched. Writes `orbit.gif` and `orbit.png`, a contact sheet with the turned views and, for a
mesh, the same views rendered from it.
"""

import argparse
from io import BytesIO
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _begin import fail, make_folder
from PIL import Image

from jaxfx import PinholeCamera, exr, io, relight, reproject, scene
from jaxfx._files import write_whole


# Images on the contact sheet.
SHEET = 5


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given = parser.add_mutually_exclusive_group()
    given.add_argument("--scene", type=Path, help="a mesh; without it, a still life")
    given.add_argument("--image", type=Path, help="an EXR file with color and `depth`")
    parser.add_argument("--size", type=int, default=256, help="side of a mesh's image, pixels")
    parser.add_argument("--fov", type=float, default=45.0, help="of --image, degrees")
    parser.add_argument("--degrees", type=float, default=6.0, help="to either side")
    parser.add_argument("--frames", type=int, default=24, help="of the GIF")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder to write to")
    arguments = parser.parse_args()
    for name, least in (("size", 16), ("frames", SHEET)):
        if getattr(arguments, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(arguments, name)}")
    if not 0 < arguments.fov < 180:
        parser.error(f"--fov must be in (0, 180) degrees, got {arguments.fov}")
    return arguments


def load(arguments: argparse.Namespace):
    """The image, its depth, its camera and, for a mesh, a function from camera to image."""
    try:
        if arguments.image is not None:
            channels = exr.read(arguments.image)
            image, depth = jnp.asarray(channels[""]), jnp.asarray(channels["depth"])
            fov, (height, width) = np.deg2rad(arguments.fov), depth.shape
            return image, depth, PinholeCamera.from_fov(fov, height=height, width=width), None
        mesh = scene.still_life() if arguments.scene is None else scene.load(arguments.scene)
        eye = scene.default_camera(mesh, height=arguments.size, width=arguments.size)
        lights = scene.default_lights(eye)

        def rendered(eye):
            buffer = scene.gbuffer(mesh, eye, height=arguments.size, width=arguments.size)
            return relight.render(buffer, eye, lights), buffer.depth

        return *rendered(eye), eye, lambda eye: rendered(eye)[0]
    except KeyError as error:
        fail(f"--image must hold color and `depth`, it lacks {error}")
    except (OSError, ValueError, RuntimeError) as error:
        fail(error)


def turned(eye: PinholeCamera, degrees: float, distance: float) -> PinholeCamera:
    """The camera turned about a point of its axis, around the image's vertical."""
    angle = np.deg2rad(degrees)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(4)
    turn[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    turn[:3, 3] = [distance * s, 0, distance * (1 - c)]
    pose = np.asarray(eye.world_from_camera, float) @ turn
    return PinholeCamera(eye.intrinsics, jnp.asarray(pose, eye.intrinsics.dtype))


def hatched(image, alpha) -> np.ndarray:
    """The image, with dark stripes in holes."""
    stripes = np.add.outer(*map(np.arange, alpha.shape)) // 3 % 2 * 0.04 + 0.01
    return np.where(np.asarray(alpha)[..., None] > 0, image, stripes[..., None])


def to_bytes(image) -> np.ndarray:
    """sRGB bytes of linear radiance."""
    value = np.clip(np.asarray(image, float), 0, 1)
    return np.round(255 * io.srgb_from_linear(value)).astype(np.uint8)


def write_image(image: Image.Image, path: Path, **options) -> None:
    """Write an image file, whole or not at all."""
    buffer = BytesIO()
    image.save(buffer, path.suffix[1:].upper(), **options)
    write_whole(path, buffer.getvalue())


def main() -> None:
    arguments = parse()
    out = make_folder(arguments.out)
    image, depth, eye, render = load(arguments)
    known = np.asarray(depth)[np.isfinite(depth) & (np.asarray(depth) > 0)]
    if not known.size:
        fail("the image has no depth anywhere")
    distance = float(np.median(known))

    view = jax.jit(lambda target: reproject.warp(image, depth, eye, target))

    def drawn(degrees):
        return hatched(*view(turned(eye, degrees, distance)))

    turns = arguments.degrees * np.sin(
        np.arange(arguments.frames) * 2 * np.pi / arguments.frames
    )
    frames = [Image.fromarray(to_bytes(drawn(degrees))) for degrees in turns]
    animation = {"save_all": True, "append_images": frames[1:], "duration": 60, "loop": 0}
    write_image(frames[0], out / "orbit.gif", **animation)
    stops = np.linspace(-arguments.degrees, arguments.degrees, SHEET)
    rows = [[drawn(degrees) for degrees in stops]]
    if render is not None:
        rows.append([np.asarray(render(turned(eye, degrees, distance))) for degrees in stops])
    sheet = np.concatenate([np.concatenate(list(map(to_bytes, row)), axis=1) for row in rows])
    write_image(Image.fromarray(sheet), out / "orbit.png")
    share = float(np.mean(view(turned(eye, arguments.degrees, distance))[1]))
    print(f"at {arguments.degrees:g} degrees {100 * share:.0f} % of the pixels are known")
    print(f"wrote {out / 'orbit.gif'} and {out / 'orbit.png'}")


if __name__ == "__main__":
    main()
