"""Helpers of `pipeline.py`: arguments, timing, Levenberg-Marquardt and figures."""

import argparse
import statistics
import time
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np

from jaxfx import io
from jaxfx._files import write_whole


matplotlib.use("Agg")
import matplotlib.pyplot as plt


# The note printed below the standard errors.
IF_NOISE = """\
if noise: the standard errors, if all that is left were noise. They are too small: derivatives
miss silhouettes, and the model misses what the mesh alone has (--of-mesh)"""


def parsed(parser: argparse.ArgumentParser, least: Mapping[str, float]) -> Any:
    """The parsed arguments; an error for a number below its entry in `least`."""
    arguments = parser.parse_args()
    for name, bound in least.items():
        if not (value := getattr(arguments, name)) >= bound:
            parser.error(f"--{name.replace('_', '-')} must be at least {bound}, got {value}")
    return arguments


def timed(name: str, call: Callable[[], Any], given: dict[str, Any]) -> float:
    """Median milliseconds of five calls after the first, printed; `given` keeps the result."""
    given[name], times = jax.block_until_ready(call()), [time.perf_counter()]
    for _ in range(5):
        jax.block_until_ready(call())
        times.append(time.perf_counter())
    milliseconds = 1e3 * statistics.median(np.diff(times).tolist())
    print(f"{name:24}{milliseconds:9.1f} ms", flush=True)
    return milliseconds


def equations(image, jacobian) -> tuple[float, np.ndarray, np.ndarray]:
    """The mean square of the residual, half of its gradient, and J^T J over its size."""
    rows = np.concatenate([jacobian, np.asarray(image)[..., None]], axis=-1, dtype=float)
    squares = np.einsum("yxci,yxcj->ij", rows, rows, optimize=True) / np.size(image)
    return squares[-1, -1], squares[-1, :-1], squares[:-1, :-1]


def descend(model: Callable, numbers: np.ndarray, free: int, steps: int):
    """Levenberg-Marquardt in the first `free` numbers, each damped by its column's size."""
    damping, taken, (loss, slope, squares) = 1e-2, 0, model(numbers)
    while taken < steps:
        taken, move = taken + 1, np.zeros_like(numbers)
        damped = squares + damping * np.diag(np.diag(squares))
        move[:free] = np.linalg.lstsq(damped[:free, :free], -slope[:free])[0]
        then, *rest = model(numbers + move)
        if then < loss:
            numbers, gain = numbers + move, 1 - then / loss
            (slope, squares), loss, damping = rest, then, damping / 5
            if gain < 1e-3:
                break
        else:
            damping *= 8
    return numbers, loss, squares, taken


def print_table(columns: Mapping[str, Mapping[str, float]]) -> None:
    print(f"\n{'errors':24}" + "".join(f"{title:>11}" for title in columns))
    for name in next(iter(columns.values())):
        values = (column[name] for column in columns.values())
        print(f"{name:24}" + "".join(f"{value:11.3g}" for value in values))


def shown(linear) -> np.ndarray:
    """An image in sRGB, for a screen."""
    return np.asarray(io.srgb_from_linear(np.clip(np.asarray(linear), 0, 1)))


def gray(difference, span: float | None = None) -> np.ndarray:
    """Gray where nothing changes, black to white over `span`; by default 99 % of values fit."""
    span = span or max(2 * np.percentile(np.abs(difference), 99), 1e-12)
    return np.clip(0.5 + np.asarray(difference) / span, 0, 1)


def write_panels(path: Path, images: Mapping[str, np.ndarray]) -> None:
    """Write images in rows of three, each under its title."""
    rows = -(-len(images) // 3)
    figure, axes = plt.subplots(rows, 3, figsize=(13.2, 3.6 * rows), layout="constrained")
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, image) in zip(axes.flat, images.items(), strict=False):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title, fontsize=10)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=90)
    plt.close(figure)
    write_whole(path, buffer.getvalue())
