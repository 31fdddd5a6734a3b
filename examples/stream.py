"""Pull the focus through a sequence of frames that need not fit in memory.

    stream.py FOLDER --near 2 --far 8 --aperture 0.1 --focal 800

FOLDER/color holds the frames (PNG, JPEG or EXR) and FOLDER/depth a depth of the same name for
each (PNG, PFM, NumPy or EXR, in scene units); an EXR may hold its own depth. FOLDER/refocused
gets a PNG for each: the focus moves from --near in the first to --far in the last. The next
frames are read, and the last ones written, while one is computed. What is written is written
whole, and not computed again when the program is started again: delete it for other settings.
"""

import argparse
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from _begin import fail, make_folder
from tqdm.auto import tqdm

from jaxfx import ThinLens, dof, io


# Frames that are read ahead, and that wait to be written. More only cost memory.
AHEAD = 2


def depth_of(color: Path) -> Path:
    """The depth of a frame: a file of its own, or the EXR file of the frame."""
    found = sorted((color.parent.parent / "depth").glob(f"{color.stem}.*"))
    if not found and color.suffix.lower() == ".exr":
        return color
    if len(found) != 1:
        fail(f"there must be one depth for {color.name}, found {len(found)}")
    return found[0]


def read(color: Path, depth: Path) -> tuple[np.ndarray, np.ndarray]:
    """A frame and its depth, in float32."""
    image = np.asarray(io.read_color(color), np.float32)
    return image, np.asarray(io.read_depth(depth), np.float32)


def stream(folder: Path, near: float, far: float, lens: dict, max_coc: float) -> None:
    """Refocus what is not yet written."""
    out = make_folder(folder / "refocused")
    colors = sorted((folder / "color").glob("*"))
    if not colors:
        fail(f"there are no frames in {folder / 'color'}")
    focuses = np.linspace(near, far, len(colors), dtype=np.float32)
    left = [
        (color, depth_of(color), out / f"{color.stem}.png", focus)
        for color, focus in zip(colors, focuses, strict=True)
        if not (out / f"{color.stem}.png").exists()
    ]

    @jax.jit
    def blurred(image, depth, focus):
        at = ThinLens(focus_distance=focus, **lens)
        return dof.scatter(image, depth, at, max_coc=max_coc)

    with ThreadPoolExecutor(2) as reader, ThreadPoolExecutor(1) as writer:
        ahead = deque(reader.submit(read, *frame[:2]) for frame in left[:AHEAD])
        behind = deque()
        for i, (*_, path, focus) in enumerate(tqdm(left, unit="frame")):
            if i + AHEAD < len(left):
                ahead.append(reader.submit(read, *left[i + AHEAD][:2]))
            result = blurred(*ahead.popleft().result(), focus)
            behind.append(
                writer.submit(lambda p, r: io.write_png(p, np.asarray(r)), path, result)
            )
            if len(behind) > AHEAD:
                behind.popleft().result()
        for write in behind:
            write.result()


def main() -> None:
    """Read the arguments and refocus."""
    parser = argparse.ArgumentParser(description="Pull the focus through a folder of frames.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--near", type=float, required=True, help="focus of the first frame")
    parser.add_argument("--far", type=float, required=True, help="focus of the last frame")
    parser.add_argument("--aperture", type=float, default=0.05, help="diameter, scene units")
    parser.add_argument("--focal", type=float, default=1000.0, help="focal length, pixels")
    parser.add_argument("--max-coc", type=float, default=16.0, help="largest circle, pixels")
    given = parser.parse_args()
    lens = {"aperture": given.aperture, "focal_pixels": given.focal}
    stream(given.folder, given.near, given.far, lens, given.max_coc)


if __name__ == "__main__":
    main()
