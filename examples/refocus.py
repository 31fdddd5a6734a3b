"""Refocus a photograph that has a depth for every pixel.

Takes a colour picture and its depth, of an RGB-D camera say, and gives each pixel the circle of
confusion that a lens of the given aperture would have. Writes for every focus a picture
`focus_DEPTH.png`, with `focus_DEPTH.exr` beside it (linear light, the depth in use and the
circles), and for all of them one figure, `refocus.png`.

Where the depth is missing (0, NaN or negative), it is filled along the row with the farther of
the nearest known depths on either side, since what such a camera misses lies mostly in the
shadow that a near thing casts on what is behind it; in a row that knows nothing, along the
column.
"""

import argparse
import math
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from _begin import fail, make_folder
from tqdm.auto import tqdm

from jaxfx import ThinLens, dof, exr, io
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


METHODS = {
    "layered": dof.layered,
    "scatter": dof.scatter,
}
# Where no aperture is asked for: the largest circle of confusion, as a share of the width.
LARGEST_COC = 0.025
# Where no focal length is known: that of a field of view of 60 degrees across.
FOCAL_PER_WIDTH = 0.5 / math.tan(math.radians(30))


def positive(text: str) -> float:
    """A number above 0, as 0.0002 or as 1/5000."""
    try:
        value = float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value


def focus(text: str) -> float | tuple[int, int]:
    """A depth, or the pixel x,y whose depth it is."""
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
    add("color", type=Path, help="PNG (sRGB) or EXR (linear), height by width")
    add(
        "depth",
        type=Path,
        help="PNG or EXR of the same size; along the optical axis, not the ray",
    )
    add(
        "--focus",
        type=focus,
        nargs="+",
        help="depths in scene units, or pixels X,Y; without it, the median depth",
    )
    add("--aperture", type=positive, help="diameter of the lens, scene units")
    add(
        "--depth-scale",
        type=positive,
        help="scene units of one step of the depth file, 1/5000 say; without it, 1/1000 for "
        "PNG (millimetres to metres) and 1 for EXR",
    )
    add("--focal", type=positive, help="focal length in pixels; without it, 60 degrees across")
    add("--max-coc", type=positive, help="largest circle of confusion, pixels")
    add("--method", choices=METHODS, default="layered", help="how sprites meet at a pixel")
    add("--out", type=Path, default=Path("out"), help="folder to write to")
    return parser.parse_args()


def read_color(path: Path) -> np.ndarray:
    """Linear light, height width 1 or 3, float32."""
    if path.suffix.lower() == ".exr":
        channels = exr.read(path)
        if "" not in channels:
            raise ValueError(f"`{path}` must have channels R, G, B, got {[*channels]}.")
        image = channels[""].astype(np.float32)
    else:
        image = io.read_png(path)
    return image[..., : 3 if image.shape[2] > 2 else 1]


def read_depth(path: Path, scale: float | None) -> np.ndarray:
    """Scene units, height width, float32; what is missing is NaN."""
    if path.suffix.lower() == ".exr":
        planes = [a for name, a in exr.read(path).items() if name == "depth" or a.ndim == 2]
        if not planes:
            raise ValueError(f"`{path}` must have a channel Z or one of two dimensions.")
        values, scale = planes[0], scale or 1.0
    else:
        from PIL import Image, UnidentifiedImageError

        try:
            with Image.open(path, formats=("PNG",)) as picture:
                values = np.asarray(picture)
        except (UnidentifiedImageError, SyntaxError) as error:
            raise ValueError(f"`{path}` is damaged or not PNG: {error}") from error
        scale = scale or 1e-3
    values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
    if values.ndim != 2:
        raise ValueError(f"`{path}` must have one channel of depth, got shape {values.shape}.")
    depth = values.astype(np.float32) * np.float32(scale)
    return np.where(depth > 0, depth, np.float32(np.nan))


def filled(depth: np.ndarray) -> np.ndarray:
    """The depth without holes, by the rule that the module's docstring states."""
    known = ~np.isnan(depth)
    if not known.any():
        raise ValueError("the depth must be known somewhere, got none above 0")
    along_rows = _farther_end(depth)
    along_columns = _farther_end(along_rows.T).T
    return np.where(known, depth, np.where(np.isnan(along_rows), along_columns, along_rows))


def _farther_end(depth: np.ndarray) -> np.ndarray:
    """In each gap of a row, the larger of the depths at its two ends; NaN in an empty row."""
    known = ~np.isnan(depth)
    column = np.arange(depth.shape[1])
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    behind = np.where(known, column, depth.shape[1])[:, ::-1]
    behind = np.minimum.accumulate(behind, axis=1)[:, ::-1]
    ends = [
        np.where(inside, np.take_along_axis(depth, np.where(inside, end, 0), axis=1), -np.inf)
        for end, inside in ((before, before >= 0), (behind, behind < depth.shape[1]))
    ]
    larger = np.maximum(*ends)
    return np.where(np.isneginf(larger), np.float32(np.nan), larger)


def focus_depth(chosen: float | tuple[int, int], depth: np.ndarray) -> float:
    if not isinstance(chosen, tuple):
        return chosen
    x, y = chosen
    height, width = depth.shape
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"--focus must lie in the {width} x {height} picture, got {x},{y}")
    return float(depth[y, x])


def widest(depth: np.ndarray, distance: float, focal: float, width: int) -> float:
    """The aperture whose largest circle of confusion is LARGEST_COC of the width."""
    unit = float(np.max(np.abs(1 / distance - 1 / depth)))
    return LARGEST_COC * width / (focal * max(unit, 1e-6))


def save_figure(pictures: dict, depth, missing, path: Path) -> None:
    """The photograph, its depth with what was missing, and every picture."""
    count = 2 + len(pictures)
    columns = min(count, 3)
    rows = -(-count // columns)
    height, width = depth.shape
    size = (5 * columns, (5 * height / width + 0.35) * rows)
    figure, axes = plt.subplots(
        rows, columns, figsize=size, layout="constrained", squeeze=False
    )
    axes = list(axes.flat)
    for ax, (title, picture) in zip(axes[:1] + axes[2:], pictures.items(), strict=False):
        ax.imshow(io.srgb_from_linear(np.clip(picture, 0, 1)), cmap="gray")
        ax.set_title(title)
    shown = axes[1].imshow(depth, cmap="viridis")
    figure.colorbar(shown, ax=axes[1], label="scene units")
    marks = np.zeros((*depth.shape, 4))
    marks[missing] = (1, 0, 0, 0.6)
    axes[1].imshow(marks)
    axes[1].set_title(f"depth; {missing.mean():.0%} was missing, red")
    for ax in axes:
        ax.set_axis_off()
    buffer = BytesIO()
    figure.savefig(buffer, dpi=110)
    plt.close(figure)
    write_whole(path, buffer.getvalue())


def main() -> None:
    arguments = parse()
    out = make_folder(arguments.out)
    try:
        color = read_color(arguments.color)
        measured = read_depth(arguments.depth, arguments.depth_scale)
        if measured.shape != color.shape[:2]:
            raise ValueError(
                f"both pictures must have one height and width, got {color.shape[:2]} and "
                f"{measured.shape}"
            )
        depth = filled(measured)
        chosen = arguments.focus or [float(np.median(depth))]
        distances = [focus_depth(each, depth) for each in chosen]
    except (OSError, ValueError) as error:
        fail(error)

    width = depth.shape[1]
    focal = arguments.focal or FOCAL_PER_WIDTH * width
    pictures = {"photograph": color}
    for distance in tqdm(distances, "focus", leave=False):
        aperture = arguments.aperture or widest(depth, distance, focal, width)
        lens = ThinLens(aperture, distance, focal)
        circles = np.asarray(lens.circle_of_confusion(jnp.asarray(depth)))
        max_coc = arguments.max_coc or max(float(circles.max()), 1.0)
        image = np.asarray(METHODS[arguments.method](color, depth, lens, max_coc=max_coc))
        name = f"focus_{distance:.3g}"
        exr.write(out / f"{name}.exr", {"": image, "depth": depth, "coc": circles})
        io.write_png(out / f"{name}.png", image)
        largest = min(max_coc, float(circles.max()))
        pictures[f"focus at {distance:.3g}, circles up to {largest:.0f} pixels"] = image
    save_figure(pictures, depth, np.isnan(measured), out / "refocus.png")
    print(f"pictures in {out}")


if __name__ == "__main__":
    main()
