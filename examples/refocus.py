"""Refocus a photograph or a rendering that has a depth for every pixel.

Takes an image and its depth, and spreads each pixel over the circle of confusion that a lens of
the given aperture would have. Writes for every focus an image `focus_DEPTH.png`, with
`focus_DEPTH.exr` beside it (linear light, the depth in use and the circles), and for all of
them one figure, `refocus.png`.

    refocus.py color.png depth.png                              16 bits, in millimetres
    refocus.py color.jpg depth.png --depth-scale 1/5000         an RGB-D camera's own steps
    refocus.py render.exr --layer ViewLayer                     Blender's multilayer EXR
    refocus.py photo.jpg midas.npy --disparity --disparity-scale 0.01 --disparity-shift 0.1
    refocus.py left.png disp0.pfm --disparity --focal 3979 --baseline 0.193 --offset 124
    refocus.py color.exr distance.exr --ray --focal 800         along the ray, not the axis

Kinds of files are told from their content, not from their names. Where the depth is missing (0,
negative or NaN) it is filled by `jaxfx.depth.fill`; inf, and the 1e10 and 65504 of renderers,
is background.
"""

import argparse
import math
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from _begin import fail, make_folder
from matplotlib.figure import Figure
from tqdm.auto import tqdm

from jaxfx import PinholeCamera, ThinLens, depth as depths, dof, exr, io
from jaxfx._files import write_whole


METHODS = {
    "layered": dof.layered,
    "scatter": dof.scatter,
}
# The largest circle of confusion, as a ratio to the width, where no aperture is given.
LARGEST_COC = 0.025
# The focal length over the width where none is given: a field of view of 60 degrees across.
FOCAL_PER_WIDTH = 0.5 / math.tan(math.radians(30))
# Scene units of one step of an integer depth where no scale is given.
MILLI = 1e-3
# Options that a depth does not have: with one of them DEPTH is a disparity.
OF_DISPARITY = ("baseline", "offset", "disparity_scale", "disparity_shift")


def number(text: str) -> float:
    """Any number, as 0.0002 or as 1/5000."""
    try:
        value = float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}") from None
    return value


def positive(text: str) -> float:
    """A number above 0, as 0.0002 or as 1/5000."""
    try:
        value = number(text)
    except argparse.ArgumentTypeError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value


def focus(text: str) -> float | tuple[int, int]:
    """A depth, or the pixel x,y at whose depth to focus."""
    if "," not in text:
        return positive(text)
    try:
        x, y = map(int, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be DEPTH or X,Y, got {text!r}") from None
    return x, y


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("color", type=Path, help="PNG or JPEG (sRGB) or EXR (linear)")
    add(
        "depth",
        type=Path,
        nargs="?",
        help="PNG, EXR, PFM, NPY or NPZ of the same size; without it COLOR is an EXR file that "
        "has both",
    )
    add(
        "--focus",
        type=focus,
        nargs="+",
        help="depths in scene units, or pixels X,Y; without it, the median depth",
    )
    add("--layer", help="the layer of an EXR file that has several")
    add("--behind", help="the layer of COLOR that shows what the first one hides")
    add("--aperture", type=positive, help="diameter of the lens, scene units")
    add("--focal", type=positive, help="focal length in pixels; without it, 60 degrees across")
    add(
        "--depth-scale",
        type=positive,
        help="scene units of one step of DEPTH (of a pair's disparity: pixels), 1/5000 say; "
        "without it, 1/1000 for a depth in integers, else 1",
    )
    add("--ray", action="store_true", help="DEPTH is the distance along each pixel's ray")
    add("--disparity", action="store_true", help="DEPTH is a disparity, larger where nearer")
    add("--disparity-scale", type=number, help="1 / depth for a step of the disparity")
    add("--disparity-shift", type=number, default=0.0, help="1 / depth where it is 0")
    add("--baseline", type=positive, help="of a pair of cameras, scene units; needs --focal")
    add("--offset", type=number, default=0.0, help="the pair's `doffs`, pixels")
    add("--fill", choices=("guided", "rows"), default="guided", help="how holes are filled")
    add("--max-coc", type=positive, help="largest circle of confusion, pixels")
    add("--method", choices=METHODS, default="layered", help="how sprites meet at a pixel")
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    return parser.parse_args()


def colors(image: np.ndarray) -> np.ndarray:
    """An image without its alpha."""
    return image[..., : 3 if image.shape[2] > 2 else 1]


def read_depth(arguments: argparse.Namespace) -> np.ndarray:
    """Depth in scene units along the axis, height width, float32; NaN where it is missing."""
    is_depth = not arguments.disparity
    if is_depth and (given := [name for name in OF_DISPARITY if getattr(arguments, name)]):
        raise ValueError(f"--{given[0].replace('_', '-')} must have --disparity")
    stored = io.read_depth(arguments.depth)
    scale = arguments.depth_scale or (MILLI if is_depth and stored.dtype.kind in "iu" else 1.0)
    if is_depth:
        depth = depths.clean(stored, unit=scale)
    elif arguments.baseline and arguments.focal:
        depth = depths.from_stereo(
            stored * np.float32(scale),
            focal_pixels=arguments.focal,
            baseline=arguments.baseline,
            disparity_offset=arguments.offset,
        )
    elif arguments.disparity_scale and not arguments.baseline:
        depth = depths.from_disparity(
            stored * np.float32(scale),
            scale=arguments.disparity_scale,
            shift=arguments.disparity_shift,
        )
    else:
        raise ValueError(
            "--disparity must have --disparity-scale, or --baseline and --focal of a pair"
        )
    return np.asarray(depth, np.float32)


def read(arguments: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    """The image and its depth, with holes."""
    if arguments.depth is None:
        image, depth = exr.read_rgbd(arguments.color, layer=arguments.layer)
        scale = arguments.depth_scale or 1.0
        if arguments.disparity:
            raise ValueError("--disparity must have a file DEPTH of its own")
        depth = np.asarray(depths.clean(depth, unit=scale))
    else:
        image = io.read_color(arguments.color, layer=arguments.layer)
        depth = read_depth(arguments)
    if depth.shape != image.shape[:2]:
        raise ValueError(
            f"both files must have one height and width, got {image.shape[:2]} and "
            f"{depth.shape}"
        )
    return colors(image), depth


def along_axis(depth: np.ndarray, focal: float) -> np.ndarray:
    """Depth along the axis from distance along rays, of a camera centered on the image."""
    height, width = depth.shape
    matrix = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return np.asarray(depths.from_ray_distance(depth, PinholeCamera(matrix, np.eye(4))))


def read_behind(arguments: argparse.Namespace, shape: tuple[int, ...]) -> tuple | None:
    """A second layer of COLOR, for `layered`; None where none is asked for."""
    if arguments.behind is None:
        return None
    if arguments.method != "layered":
        raise ValueError(f"--behind must have --method layered, got {arguments.method}")
    image, depth = exr.read_rgbd(arguments.color, layer=arguments.behind)
    if depth.shape != shape:
        raise ValueError(
            f"--behind must have the first layer's size {shape}, got {depth.shape}"
        )
    depth = np.asarray(depths.clean(depth, unit=arguments.depth_scale or 1.0))
    # Where the second layer is missing there is nothing behind the first.
    return colors(image), np.where(np.isnan(depth), np.float32(np.inf), depth)


def focus_depth(chosen: float | tuple[int, int], depth: np.ndarray) -> float:
    """The depth to focus on, read from the depth map where it is given as a pixel."""
    if not isinstance(chosen, tuple):
        return chosen
    x, y = chosen
    height, width = depth.shape
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"--focus must lie in the {width} x {height} image, got {x},{y}")
    return float(depth[y, x])


def widest(depth: np.ndarray, distance: float, focal: float, width: int) -> float:
    """The aperture whose largest circle of confusion is `LARGEST_COC` of the width."""
    unit = float(np.max(np.abs(1 / distance - 1 / depth)))
    return LARGEST_COC * width / (focal * max(unit, 1e-6))


def save_figure(images: dict, depth: np.ndarray, filled: np.ndarray, path: Path) -> None:
    """Save the photograph, its depth with the filled holes in red, and every refocused image.

    The number of columns is one that leaves no place empty.
    """
    count = 1 + len(images)
    columns = next(c for c in (3, 4, 2, count) if count % c == 0)
    rows = count // columns
    height, width = depth.shape
    # Width for the images and the color bar of the depth, height for images and titles.
    size = (4.6 * columns + 0.6, (4.6 * height / width + 0.45) * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for ax, (title, image) in zip(axes[:1] + axes[2:], images.items(), strict=True):
        ax.imshow(io.srgb_from_linear(np.clip(image, 0, 1)), cmap="gray")
        ax.set_title(title)
    finite = depth[np.isfinite(depth)]
    span = (finite.min(), finite.max()) if finite.size else (0, 1)
    shown = axes[1].imshow(depth, cmap="viridis", vmin=span[0], vmax=span[1])
    figure.colorbar(shown, ax=axes[1], label="scene units", shrink=0.8)
    marks = np.zeros((*depth.shape, 4))
    marks[filled] = (1, 0, 0, 0.6)
    axes[1].imshow(marks)
    sky = "; the sky is white" if finite.size < depth.size else ""
    axes[1].set_title(f"depth; {filled.mean():.0%} was missing, red{sky}")
    for ax in axes:
        ax.set_axis_off()
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110)
    write_whole(path, buffer.getvalue())


def main() -> None:
    arguments = parse()
    out = make_folder(arguments.out)
    try:
        color, depth = read(arguments)
        behind = read_behind(arguments, depth.shape)
        width = depth.shape[1]
        focal = arguments.focal or FOCAL_PER_WIDTH * width
        if arguments.ray:
            depth = along_axis(depth, focal)
        whole = depths.fill(depth, color, method=arguments.fill)
        depth, filled = np.asarray(whole.depth), np.asarray(whole.filled)
        chosen = arguments.focus or [float(np.median(depth))]
        distances = [focus_depth(choice, depth) for choice in chosen]
    except (OSError, ValueError) as error:
        fail(error)

    images = {"photograph": color}
    options = {} if behind is None else {"behind": behind}
    for distance in tqdm(distances, "focus", leave=False):
        aperture = arguments.aperture or widest(depth, distance, focal, width)
        lens = ThinLens(aperture, distance, focal)
        circles = np.asarray(lens.circle_of_confusion(jnp.asarray(depth)))
        max_coc = arguments.max_coc or max(float(circles.max()), 1.0)
        method = METHODS[arguments.method]
        image = np.asarray(method(color, depth, lens, max_coc=max_coc, **options))
        name = f"focus_{distance:.5g}"
        exr.write(out / f"{name}.exr", {"": image, "depth": depth, "coc": circles})
        io.write_png(out / f"{name}.png", image)
        largest = min(max_coc, float(circles.max()))
        images[f"focus at {distance:.3g}, circles up to {largest:.0f} pixels"] = image
    save_figure(images, depth, filled, out / "refocus.png")
    print(f"images in {out}")


if __name__ == "__main__":
    main()
