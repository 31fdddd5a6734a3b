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
is background. What is transparent is shown over black.
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
# The range of what is computed with.
TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
# Options of a disparity: of a pair of cameras, and of a network.
OF_PAIR = ("--baseline", "--offset")
OF_NETWORK = ("--disparity-scale", "--disparity-shift")
# Options of a file DEPTH.
OF_FILE = ("--depth-layer", "--disparity")
# A circle of confusion, in pixels, that is not refused for exceeding a small image.
COC_OF_ANY_SIZE = 64
# The first bytes of an EXR file, whose alpha is premultiplied.
EXR = b"v/1\x01"


def number(text: str) -> float:
    """Any finite number, as 0.0002 or as 1/5000."""
    try:
        value = float(Fraction(text))
    except (ValueError, ArithmeticError):
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r:.60}") from None
    return value


def positive(text: str) -> float:
    """A number above 0, as 0.0002 or as 1/5000."""
    try:
        value = number(text)
    except argparse.ArgumentTypeError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r:.60}")
    if not TINY <= value <= HUGE:
        raise argparse.ArgumentTypeError(f"must be a number of float32, got {text!r:.60}")
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
    add("--layer", help="the layer of COLOR, an EXR file that has several")
    add("--depth-layer", help="the layer of DEPTH, an EXR file that has several")
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
    add("--disparity-scale", type=positive, help="1 / depth for a step of the disparity")
    add("--disparity-shift", type=number, default=0.0, help="1 / depth where it is 0")
    add("--baseline", type=positive, help="of a pair of cameras, scene units; needs --focal")
    add("--offset", type=number, default=0.0, help="the pair's `doffs`, pixels")
    add("--fill", choices=("guided", "rows"), default="guided", help="how holes are filled")
    add("--max-coc", type=positive, help="largest circle of confusion, pixels")
    add("--method", choices=METHODS, default="layered", help="how sprites meet at a pixel")
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    return parser.parse_args()


def colors(image: np.ndarray, *, is_straight: bool = False) -> np.ndarray:
    """An image without its alpha, over black; with straight alpha it is not yet multiplied."""
    channels = 3 if image.shape[2] > 2 else 1
    has_alpha = image.shape[2] in (2, 4)
    return image[..., :channels] * (image[..., -1:] if has_alpha and is_straight else 1)


def check_options(arguments: argparse.Namespace) -> None:
    """`ValueError` for an option that would be left out."""
    given = [f"--{name.replace('_', '-')}" for name, value in vars(arguments).items() if value]
    if arguments.depth is None and (of_file := [name for name in OF_FILE if name in given]):
        raise ValueError(f"{of_file[0]} must have a file DEPTH of its own")
    of_disparity = [name for name in given if name in OF_PAIR + OF_NETWORK]
    if of_disparity and not arguments.disparity:
        raise ValueError(f"{of_disparity[0]} must have --disparity")
    if arguments.baseline and (of_network := [name for name in given if name in OF_NETWORK]):
        raise ValueError(f"{of_network[0]} must be without --baseline, of a pair")
    if arguments.offset and not arguments.baseline:
        raise ValueError("--offset must have --baseline and --focal of a pair")
    if arguments.behind is not None and arguments.method != "layered":
        raise ValueError(f"--behind must have --method layered, got {arguments.method}")


def read_depth(arguments: argparse.Namespace) -> np.ndarray:
    """Depth in scene units along the axis, height width, float32; NaN where it is missing."""
    stored = io.read_depth(arguments.depth, layer=arguments.depth_layer)
    is_integer = stored.dtype.kind in "iu"
    scale = arguments.depth_scale or (MILLI if is_integer and not arguments.disparity else 1.0)
    if not arguments.disparity:
        depth = depths.clean(stored, unit=scale)
    elif arguments.baseline and arguments.focal:
        depth = depths.from_stereo(
            stored * np.float32(scale),
            focal_pixels=arguments.focal,
            baseline=arguments.baseline,
            disparity_offset=arguments.offset,
        )
    elif arguments.disparity_scale:
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
    check_options(arguments)
    if arguments.depth is None:
        return read_layer(arguments, arguments.layer)
    image = io.read_color(arguments.color, layer=arguments.layer)
    with arguments.color.open("rb") as file:
        is_straight = file.read(len(EXR)) != EXR
    depth = read_depth(arguments)
    if depth.shape != image.shape[:2]:
        raise ValueError(
            f"both files must have one height and width, got {image.shape[:2]} and "
            f"{depth.shape}"
        )
    return colors(image, is_straight=is_straight), along_axis(depth, arguments)


def read_layer(
    arguments: argparse.Namespace, layer: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """The image and the depth of a layer of COLOR, with holes.

    Beside a file DEPTH, what is said of its numbers does not hold for those of COLOR.
    """
    image, depth = exr.read_rgbd(arguments.color, layer=layer)
    if arguments.depth is None:
        depth = np.asarray(depths.clean(depth, unit=arguments.depth_scale or 1.0))
        depth = along_axis(depth, arguments)
    return colors(image), depth


def focal_length(arguments: argparse.Namespace, width: int) -> float:
    """In pixels."""
    return arguments.focal or FOCAL_PER_WIDTH * width


def along_axis(depth: np.ndarray, arguments: argparse.Namespace) -> np.ndarray:
    """Depth along the axis; with `--ray`, from distance, of a camera centered on the image."""
    if not arguments.ray:
        return depth
    height, width = depth.shape
    focal = focal_length(arguments, width)
    matrix = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return np.asarray(depths.from_ray_distance(depth, PinholeCamera(matrix, np.eye(4))))


def read_behind(arguments: argparse.Namespace, shape: tuple[int, ...]) -> tuple | None:
    """A second layer of COLOR, for `layered`; None where none is asked for."""
    if arguments.behind is None:
        return None
    image, depth = read_layer(arguments, arguments.behind)
    if depth.shape != shape:
        raise ValueError(
            f"--behind must have the first layer's size {shape}, got {depth.shape}"
        )
    # Where the second layer is missing there is nothing behind the first.
    return image, np.where(np.isnan(depth), np.float32(np.inf), depth)


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
    unit = float(np.max(np.abs(1 / distance - 1 / depth.astype(np.float64))))
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
    # At most twice as high as wide: at its own shape, a column of pixels takes all memory.
    size = (4.6 * columns + 0.6, (4.6 * min(height / width, 2) + 0.45) * rows)
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


def names(distances: list[float]) -> list[str]:
    """Of the foci, with as many digits as tell them apart."""
    digits = next(
        (n for n in (5, 9) if len({f"{d:.{n}g}" for d in distances}) == len(distances)), 17
    )
    return [f"{distance:.{digits}g}" for distance in distances]


def refocus(arguments: argparse.Namespace, out: Path) -> None:
    """Read the image and its depth, and write every file to the folder `out`."""
    color, depth = read(arguments)
    behind = read_behind(arguments, depth.shape)
    height, width = depth.shape
    focal = focal_length(arguments, width)
    if not (depth > 0).any():
        raise ValueError(f"`{arguments.depth or arguments.color}` must have a depth above 0")
    whole = depths.fill(depth, color, method=arguments.fill)
    depth, filled = np.asarray(whole.depth), np.asarray(whole.filled)
    chosen = arguments.focus or [float(np.median(depth))]
    distances = [*dict.fromkeys(focus_depth(choice, depth) for choice in chosen)]

    images = {"photograph": color}
    options = {} if behind is None else {"behind": behind}
    for distance, name in zip(
        tqdm(distances, "focus", leave=False), names(distances), strict=True
    ):
        aperture = arguments.aperture or widest(depth, distance, focal, width)
        lens = ThinLens(aperture, distance, focal)
        circles = np.asarray(lens.circle_of_confusion(jnp.asarray(depth)))
        largest = float(circles.max())
        limit = arguments.max_coc or max(math.hypot(height, width), COC_OF_ANY_SIZE)
        if largest > limit and not arguments.max_coc:
            raise ValueError(
                f"--aperture must be in the unit of DEPTH, got {aperture:g}: a circle of "
                f"confusion of {largest:.3g} pixels exceeds the image; --max-coc cuts it"
            )
        max_coc = min(max(largest, 1.0), limit)
        method = METHODS[arguments.method]
        image = np.asarray(method(color, depth, lens, max_coc=max_coc, **options))
        exr.write(out / f"focus_{name}.exr", {"": image, "depth": depth, "coc": circles})
        io.write_png(out / f"focus_{name}.png", image)
        images[f"focus at {name}, circles up to {min(largest, max_coc):.0f} pixels"] = image
    save_figure(images, depth, filled, out / "refocus.png")


def main() -> None:
    arguments = parse()
    out = make_folder(arguments.out)
    try:
        refocus(arguments, out)
    except (OSError, ValueError) as error:
        fail(error)
    print(f"images in {out}")


if __name__ == "__main__":
    main()
