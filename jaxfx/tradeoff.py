"""Speed against accuracy, measured in one run and drawn on one chart."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float
from tqdm.auto import tqdm

from jaxfx import metrics


if TYPE_CHECKING:
    from matplotlib.axes import Axes


__all__ = ["Measurement", "measure", "pareto", "plot"]


class Measurement(NamedTuple):
    """One method on the chart.

    - `name`: the method's.
    - `seconds`: median time of a call.
    - `spread`: seconds between the quickest and the slowest call.
    - `psnr`, `ssim`: against the reference, decibels and a ratio.
    - `band_psnr`: decibels inside the mask; NaN where none was given.
    """

    name: str
    seconds: float
    spread: float
    psnr: float
    ssim: float
    band_psnr: float


def measure(
    methods: Mapping[str, Callable[[], ArrayLike]],
    reference: Float[ArrayLike, "height width channel"],
    *,
    mask: Bool[ArrayLike, "height width"] | None = None,
    repeats: int = 7,
    max_seconds: float = 2.0,
    progress: bool = True,
) -> list[Measurement]:
    """Time and accuracy of every method, one after another in one process.

    Each is called once to compile and to give its picture, then timed until it has `repeats`
    calls or has spent `max_seconds`, once at the least. One whose first call alone takes longer
    than `max_seconds` is not called again: that call, its compilation included, is its time.

    **Arguments:**

    - `methods`: from a name to a function of no arguments that gives an image of the
      reference's shape; it is waited for.
    - `reference`: height width channel, linear radiance.
    - `mask`: height width, the pixels that `band_psnr` is about; those near depth edges, say.
    - `repeats`: calls to time, a scalar count.
    - `max_seconds`: of timed calls for each method; a first call over it is the only one.
    - `progress`: show a bar on stderr.

    **Returns:** a list of `Measurement`, in the order of `methods`.

    **Raises:** `ValueError` for no methods, or a picture of another shape than the reference's.

    **Gradient:** none: it measures.
    """
    if not methods:
        raise ValueError("`measure(methods)` must hold at least one method, got none.")
    reference = jax.numpy.asarray(reference)
    measurements = []
    for name, method in tqdm(methods.items(), "measure", disable=not progress, leave=False):
        image, first = _timed(method)
        if image.shape != reference.shape:
            raise ValueError(
                f"`measure(methods)` must give images of the reference's shape "
                f"{reference.shape}, got {image.shape} from {name!r}."
            )
        times = [first] if first > max_seconds else [_timed(method)[1]]
        while len(times) < repeats and sum(times) < max_seconds:
            times.append(_timed(method)[1])
        band = np.nan if mask is None else metrics.psnr(image, reference, mask=mask)
        measurements.append(
            Measurement(
                name,
                statistics.median(times),
                max(times) - min(times),
                float(metrics.psnr(image, reference)),
                float(metrics.ssim(image, reference)),
                float(band),
            )
        )
    return measurements


def _timed(method: Callable[[], ArrayLike]) -> tuple[Array, float]:
    """The picture that a method gives and the seconds that it takes."""
    start = time.perf_counter()
    image = jax.numpy.asarray(jax.block_until_ready(method()))
    return image, time.perf_counter() - start


def pareto(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Those that no other beats in both time and PSNR, the quickest first.

    **Arguments:** `measurements`: a sequence of `Measurement`, of any length.

    **Returns:** the front, a list of `Measurement`.

    **Gradient:** none: it chooses.
    """
    front = []
    for one in sorted(measurements, key=lambda m: (m.seconds, -m.psnr)):
        if not front or one.psnr > front[-1].psnr:
            front.append(one)
    return front


def plot(
    measurements: Sequence[Measurement],
    ax: "Axes",
    *,
    lines: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """The chart: milliseconds, logarithmic, against PSNR, the Pareto front drawn through.

    **Arguments:**

    - `measurements`: what `measure` gave, a sequence of any length.
    - `ax`: the matplotlib axes to draw on.
    - `lines`: from a label to the names to join by a line, one method at several settings.

    **Gradient:** none: it draws.
    """
    by_name = {m.name: m for m in measurements}
    joined = {name for names in (lines or {}).values() for name in names}

    front = pareto(measurements)
    ax.step(
        [1e3 * m.seconds for m in front],
        [m.psnr for m in front],
        where="post",
        color="0.75",
        linewidth=6,
        solid_capstyle="round",
        zorder=0,
        label="Pareto front",
    )
    for label, names in (lines or {}).items():
        points = [by_name[name] for name in names]
        milliseconds = [1e3 * m.seconds for m in points]
        ax.plot(milliseconds, [m.psnr for m in points], "o-", markersize=4, label=label)
        for name, x, point in zip(names, milliseconds, points, strict=True):
            short = name.removeprefix(label).strip()
            ax.annotate(short, (x, point.psnr), xytext=(4, -10), textcoords="offset points")
    for m in measurements:
        if m.name not in joined:
            ax.errorbar(1e3 * m.seconds, m.psnr, xerr=1e3 * m.spread / 2, fmt="s", label=m.name)
    ax.set_xscale("log")
    ax.set_xlabel("time of a picture (ms, median)")
    ax.set_ylabel("PSNR to the reference (dB)")
    ax.grid(alpha=0.3)
    ax.legend()
