"""Speed or memory against accuracy, measured in one run and drawn on one chart.

| I want | call |
|---|---|
| time, memory, PSNR and SSIM of several methods | `tradeoff.measure` |
| those that no other beats | `tradeoff.pareto` |
| the chart | `tradeoff.plot` |
| the chart in a file | `tradeoff.save` |
"""

import functools
import io
import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import jax
import jax.core
import jax.stages
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfx import metrics
from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_image, number, whole_number
from jaxfx._extras import needs
from jaxfx._files import StrPath, write_whole
from jaxfx._progress import counted


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


__all__ = ["Measurement", "measure", "pareto", "plot", "save"]

Point = tuple[float, float]
Cost = Literal["seconds", "memory"]


class Measurement(NamedTuple):
    """The time, memory and accuracy of one method.

    - `name`: the method's.
    - `seconds`: median time of a call.
    - `spread`: seconds between the quickest and the slowest call.
    - `psnr`, `ssim`: against the reference, decibels and a ratio.
    - `band_psnr`: decibels inside the mask; NaN where none was given.
    - `memory`: the largest memory in use beside the arguments and the image, bytes; NaN where
      it can't be known.
    """

    name: str
    seconds: float
    spread: float
    psnr: float
    ssim: float
    band_psnr: float
    memory: float = math.nan


def measure(
    methods: Mapping[str, Callable[[], ArrayLike]],
    reference: Float[ArrayLike, "height width channel"],
    *,
    mask: Bool[ArrayLike, "height width"] | None = None,
    repeats: WholeNumber = 7,
    max_seconds: Number = 2.0,
    memory: bool = True,
    progress: bool = False,
) -> list[Measurement]:
    """Time, memory and accuracy of every method, one after another in one process.

    Each is called once to compile and for its image, then timed until it has `repeats` calls or
    has spent `max_seconds`, once at the least. A method whose first call alone takes longer
    than `max_seconds` is not called again: that call, its compilation included, is its time.

    **Arguments:**

    - `methods`: from a name to a function of no arguments that returns an image of the
      reference's shape; each call is waited for.
    - `reference`: height width channel, linear radiance.
    - `mask`: height width, the pixels of `band_psnr`: those near edges in depth, say.
    - `repeats`: calls to time, a positive integer.
    - `max_seconds`: of timed calls for each method; a first call over it is the only one.
    - `memory`: trace each method and compile it once more for its memory: that of the program
      that `jax.jit` makes of it, what it closes over counted as arguments. Of a method that
      can't be traced it is NaN. A `functools.partial` of `jax.jit(f).lower(...).compile()` is
      compiled already, and not traced.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a list of `Measurement`, in the order of `methods`.

    **Raises:** `ValueError` for no methods, an image of another shape than the reference's, or
    a number that is out of range.

    **Gradient:** none: it measures.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import tradeoff
    >>> reference = np.ones((8, 8, 3))
    >>> methods = {"half": lambda: 0.5 * reference, "most": lambda: 0.9 * reference}
    >>> measured = tradeoff.measure(methods, reference, repeats=1, memory=False)
    >>> [(m.name, round(m.psnr, 1)) for m in measured]
    [('half', 6.0), ('most', 20.0)]
    """
    if not methods:
        raise ValueError("`measure(methods)` must hold at least one method, got none.")
    reference = check_image("measure(reference)", reference)
    repeats = whole_number("measure(repeats=...)", repeats)
    max_seconds = number(
        "measure(max_seconds=...)", max_seconds, lambda x: x >= 0, "0 or positive"
    )
    measurements = []
    for name, method in counted(methods.items(), progress, "measure"):
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
                _temporary_bytes(method) if memory else math.nan,
            )
        )
    return measurements


def _temporary_bytes(method: Callable[[], ArrayLike]) -> float:
    """Bytes that one program of a method holds beside its arguments and its image."""
    if isinstance(method, functools.partial) and isinstance(method.func, jax.stages.Compiled):
        return _temporary_bytes_of(method.func)
    try:
        closed = jax.make_jaxpr(method)()
    except Exception:  # It ran before, so that it is tracing that fails.
        return math.nan
    if not closed.eqns:  # NumPy did it all.
        return math.nan

    def program(arrays: list[Array]) -> list[Array]:
        return jax.core.eval_jaxpr(closed.jaxpr, arrays)

    return _temporary_bytes_of(jax.jit(program).lower(closed.consts).compile())


def _temporary_bytes_of(program: jax.stages.Compiled) -> float:
    analysis = program.memory_analysis()
    return math.nan if analysis is None else float(analysis.temp_size_in_bytes)


def _timed(method: Callable[[], ArrayLike]) -> tuple[Array, float]:
    """The image of a method, and the seconds that it takes."""
    start = time.perf_counter()
    image = jax.numpy.asarray(jax.block_until_ready(method()))
    return image, time.perf_counter() - start


def pareto(measurements: Sequence[Measurement], *, cost: Cost = "seconds") -> list[Measurement]:
    """The measurements that no other beats in both cost and PSNR, the cheapest first.

    **Arguments:**

    - `measurements`: a sequence of `Measurement`, of any length.
    - `cost`: what is to be small: the time, or the memory; measurements without one are left
      out.

    **Returns:** the front, a list of `Measurement`.

    **Raises:** `ValueError` for an unknown `cost`.

    **Gradient:** none: it chooses.

    **Example:**

    >>> from jaxfx import tradeoff
    >>> slow = tradeoff.Measurement("slow", 2.0, 0.0, 30.0, 0.9, 30.0)
    >>> quick = tradeoff.Measurement("quick", 1.0, 0.0, 35.0, 0.9, 35.0)
    >>> [m.name for m in tradeoff.pareto([slow, quick])]
    ['quick']
    """
    _check_cost("pareto", cost)
    front = []
    known = [m for m in measurements if not math.isnan(getattr(m, cost))]
    for measurement in sorted(known, key=lambda m: (getattr(m, cost), -m.psnr)):
        if not front or measurement.psnr > front[-1].psnr:
            front.append(measurement)
    return front


def _check_cost(caller: str, cost: str) -> None:
    if cost not in get_args(Cost):
        raise ValueError(f"`{caller}(cost=...)` must be one of {get_args(Cost)}, got {cost!r}.")


# The unit of each cost on the axis, in seconds or bytes, and the label of the axis.
_AXES = {
    "seconds": (1e-3, "time of an image (ms, median)"),
    "memory": (1e6, "memory beside arguments and image (MB)"),
}


def plot(
    measurements: Sequence[Measurement],
    ax: "Axes",
    *,
    lines: Mapping[str, Sequence[str]] | None = None,
    cost: Cost = "seconds",
) -> None:
    """Draw milliseconds or megabytes against PSNR, with the Pareto front.

    Every measurement is a point with its name beside it: filled on the front, hollow where
    another beats it. Names keep clear of one another and of the points, at the size that the
    figure has now. The costs are on a logarithmic axis; if any memory is 0, it is linear below
    the smallest that is not.

    **Arguments:**

    - `measurements`: the result of `measure`, a sequence of any length.
    - `ax`: the matplotlib axes to draw on.
    - `lines`: from a label to the names to join by a line, one method at several settings. A
      point is then named by the rest of its name after the label.
    - `cost`: the time, or the memory; measurements without one are left out.

    **Raises:** `ValueError` for an unknown `cost`.

    **Gradient:** none: it draws.

    **Example:**

    >>> from matplotlib.figure import Figure
    >>> from jaxfx import tradeoff
    >>> ax = Figure().add_subplot()
    >>> tradeoff.plot([tradeoff.Measurement("scatter", 0.02, 0.001, 35.0, 0.98, 33.0)], ax)
    >>> ax.get_ylabel()
    'PSNR to the reference (dB)'
    """
    _check_cost("plot", cost)
    unit, label = _AXES[cost]
    by_name = {m.name: m for m in measurements if not math.isnan(getattr(m, cost))}
    place = lambda m: (getattr(m, cost) / unit, m.psnr)
    front = pareto(measurements, cost=cost)
    style = {"color": "0.85", "linewidth": 6, "solid_capstyle": "round", "zorder": 0}
    steps = np.reshape([place(m) for m in front], (-1, 2)).T
    ax.step(*steps, where="post", label="Pareto front", **style)

    label_of, colors, paths = {}, {}, []
    for line, names in (lines or {}).items():
        known = [name for name in names if name in by_name]
        label_of |= dict.fromkeys(known, line)
        path = np.reshape([place(by_name[name]) for name in known], (-1, 2))
        (drawn,) = ax.plot(*path.T, "-", linewidth=1, label=line)
        paths += itertools.pairwise(path)
        colors[line] = drawn.get_color()
    texts = []
    for m in by_name.values():
        color = colors.get(label_of.get(m.name), "0.15")
        xy, half = place(m), 1e3 * m.spread / 2 if cost == "seconds" else 0.0
        ax.errorbar(
            *xy,
            xerr=half,
            fmt="o" if m.name in label_of else "s",
            markersize=5,
            color=color,
            markerfacecolor=color if m in front else "white",
        )
        name = m.name.removeprefix(label_of.get(m.name, "")).strip()
        texts.append((name, xy, half, color))
    _scale(ax, [x for _, (x, _), _, _ in texts])
    ax.set_xlabel(label)
    ax.set_ylabel("PSNR to the reference (dB)")
    ax.margins(0.12)
    ax.grid(alpha=0.3)
    ax.legend(fontsize="small")
    _write_names(ax, texts, paths)


def _scale(ax: "Axes", costs: Sequence[float]) -> None:
    """Make the axis of costs logarithmic, or linear below the smallest where one is 0."""
    with needs("plot"):
        from matplotlib.ticker import LogLocator

    if 0 in costs:
        least = min((x for x in costs if x > 0), default=1.0)
        threshold = 10 ** math.floor(math.log10(least))
        ax.set_xscale("symlog", linthresh=threshold, linscale=0.4)
    else:
        ax.set_xscale("log")
        ax.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        ax.xaxis.set_minor_formatter("{x:g}")
    ax.xaxis.set_major_formatter("{x:g}")


# The sides of a point where its name may stand, in order of preference: a direction, and the
# alignment of the name there.
_SIDES = (
    (1, 0, "left", "center"),
    (0, 1, "center", "bottom"),
    (0, -1, "center", "top"),
    (-1, 0, "right", "center"),
    (0.7, 0.7, "left", "bottom"),
    (0.7, -0.7, "left", "top"),
    (-0.7, 0.7, "right", "bottom"),
    (-0.7, -0.7, "right", "top"),
)
# The part of a name, a ratio, that lies left of or below the place it is aligned to.
_PART = {"left": 0, "bottom": 0, "center": 0.5, "right": 1, "top": 1}
# Distances of a name from its point, in printer's points; from the third on a line leads there.
_DISTANCES = (6, 11, 18, 28, 40, 54, 70, 90, 115)


def _write_names(
    ax: "Axes", texts: Sequence[tuple[str, Point, float, Any]], paths: Sequence[Any]
) -> None:
    """Write a name beside each point, in the first place where it covers nothing, or least."""
    figure = ax.get_figure(root=True)
    if figure is None:
        return
    figure.draw_without_rendering()  # It lays out the axes, which have no place before.
    point, legend = figure.dpi / 72, ax.get_legend()
    # Boxes are left, bottom, right and top, in pixels.
    taken = [legend.get_window_extent().extents] if legend else []
    spots = [ax.transData.transform(xy) for _, xy, _, _ in texts]
    taken += [[*(spot - 4 * point), *(spot + 4 * point)] for spot in spots]
    for _, (x, y), half, _ in texts:
        ends = ax.transData.transform([(max(x - half, ax.get_xlim()[0]), y), (x + half, y)])
        taken.append([*(ends[0] - [0, point]), *(ends[1] + [0, point])])

    for path in paths:
        begin, end = ax.transData.transform(path)
        steps = np.linspace(begin, end, 30)
        taken += [[*(step - point), *(step + point)] for step in steps]

    places = [(distance, side) for distance in _DISTANCES for side in _SIDES]
    shifts = np.array([distance * point * np.array(side[:2]) for distance, side in places])
    aligned = np.array([[_PART[word] for word in side[2:]] for _, side in places])
    for (name, xy, _, color), spot in zip(texts, spots, strict=True):
        note = ax.annotate(
            name,
            xy,
            xytext=(0, 0),
            textcoords="offset points",
            fontsize="small",
            color=color,
            arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.4, "shrinkB": 3},
        )
        size = np.array(note.get_window_extent().size)
        low = spot + shifts - aligned * size
        boxes = np.hstack([low, low + size])
        outside = size.prod() - _shared(boxes, np.array([ax.bbox.extents])).sum(axis=1)
        covered = _shared(boxes, np.array(taken)).sum(axis=1) + outside
        best = int(np.argmin(covered.round(3)))
        distance, side = places[best]
        note.set(position=distance * np.array(side[:2]), ha=side[2], va=side[3])
        if note.arrow_patch is not None:
            note.arrow_patch.set_visible(distance >= _DISTANCES[2])
        taken.append(boxes[best])


def _shared(boxes: Any, others: Any) -> Any:
    """The areas, box other, in which boxes overlap others."""
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    return np.maximum(high - low, 0).prod(axis=-1)


def save(figure: "Figure", path: StrPath) -> None:
    """Save a chart, its text as text that can be searched and edited.

    The file is written whole or not at all.

    **Arguments:**

    - `figure`: the matplotlib figure.
    - `path`: the file; its suffix says which kind: `.pdf` and `.svg` are vectors, with fonts
      that publishers accept (TrueType, no Type 3); `.png` has 200 dots an inch.

    **Raises:** `ValueError` for a suffix that matplotlib does not know; `OSError` where the
    folder does not exist or can't be written.

    **Gradient:** none: it writes a file.

    **Example:**

    >>> from matplotlib.figure import Figure
    >>> from jaxfx import tradeoff
    >>> tradeoff.save(Figure(), "chart.svg")
    """
    with needs("plot"):
        import matplotlib

    kind = Path(path).suffix.removeprefix(".")
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise ValueError(f"`save(path)` must end in one of {sorted(known)}, got {path!r}.")
    stream = io.BytesIO()
    fonts: Any = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none"}
    with matplotlib.rc_context(fonts):
        figure.savefig(stream, format=kind, dpi=200)
    write_whole(path, stream.getbuffer())
