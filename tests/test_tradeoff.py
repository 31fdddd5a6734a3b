"""The chart: what is measured is checked without a clock, the front against brute force."""

import functools
import inspect
import math
import xml.etree.ElementTree

import hypothesis as hyp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from jaxfx import metrics, tradeoff


RNG = np.random.default_rng(0)
REFERENCE = RNG.random((16, 20, 3))
PICTURES = {"close": REFERENCE + 0.01, "far": REFERENCE + 0.1 * RNG.random(REFERENCE.shape)}


class Method:
    """Gives its image and counts its calls."""

    def __init__(self, picture):
        self.picture, self.calls = picture, 0

    def __call__(self):
        self.calls += 1
        return jnp.asarray(self.picture)


@pytest.fixture
def clock(monkeypatch):
    """Seconds that only `clock.wait` lets pass."""

    class Clock:
        now = 0.0

        def wait(self, seconds):
            self.now += seconds

    clock = Clock()
    monkeypatch.setattr(tradeoff.time, "perf_counter", lambda: clock.now)
    return clock


def measure(methods, **options):
    options = {"memory": False} | options
    return tradeoff.measure(methods, REFERENCE, progress=False, **options)


def test_scores_are_those_of_metrics_in_the_order_given():
    mask = np.zeros((16, 20), bool)
    mask[3:9, 5:] = True
    found = measure({name: Method(p) for name, p in PICTURES.items()}, mask=mask, repeats=2)
    assert [one.name for one in found] == list(PICTURES)
    for one in found:
        picture = PICTURES[one.name]
        error, band = (picture - REFERENCE) ** 2, (picture - REFERENCE)[mask] ** 2
        np.testing.assert_allclose(one.psnr, -10 * np.log10(error.mean()), rtol=1e-9)
        np.testing.assert_allclose(one.band_psnr, -10 * np.log10(band.mean()), rtol=1e-9)
        np.testing.assert_allclose(one.ssim, metrics.ssim(picture, REFERENCE))
        assert one.seconds >= 0 and one.spread >= 0
    assert all(
        math.isnan(one.band_psnr) for one in measure({"a": Method(REFERENCE)}, repeats=1)
    )


def test_time_is_the_median_after_the_first_call(clock):
    durations = iter([0.5, 0.1, 0.4, 0.2])
    method = lambda: clock.wait(next(durations)) or REFERENCE
    (found,) = measure({"a": method}, repeats=3)
    np.testing.assert_allclose([found.seconds, found.spread], [0.2, 0.3])
    assert next(durations, None) is None


def test_calls_stop_when_their_time_is_spent(clock):
    method = Method(REFERENCE)
    measure({"a": lambda: clock.wait(0.3) or method()}, repeats=99, max_seconds=1.0)
    assert method.calls == 1 + 4


def test_one_call_over_the_time_is_enough(clock):
    method = Method(REFERENCE)
    (found,) = measure({"a": lambda: clock.wait(3.0) or method()}, max_seconds=1.0)
    assert (method.calls, found.seconds, found.spread) == (1, 3.0, 0.0)


def test_faults_are_named():
    call = inspect.unwrap(tradeoff.measure)
    with pytest.raises(ValueError, match=r"`measure\(methods\)` must hold at least one"):
        call({}, REFERENCE)
    for named in ("pareto", "plot"):
        with pytest.raises(
            ValueError, match=rf"`{named}\(cost=\.\.\.\)` must be one of .*'tea'"
        ):
            arguments = [Figure().add_subplot()] if named == "plot" else []
            inspect.unwrap(getattr(tradeoff, named))([], *arguments, cost="tea")
    with pytest.raises(ValueError, match=r"\(16, 20, 3\), got \(16, 19, 3\) from 'wrong'"):
        call({"wrong": lambda: REFERENCE[:, 1:]}, REFERENCE, progress=False)


def point(name, seconds, psnr, spread=0.0):
    return tradeoff.Measurement(str(name), seconds, spread, psnr, 0.9, math.nan)


def of_memory(name, memory, psnr):
    return point(name, 1.0, psnr)._replace(memory=memory)


def test_the_front_of_memory_leaves_out_what_is_not_known():
    lean, rich = of_memory("lean", 0.0, 20.0), of_memory("rich", 3e6, 30.0)
    everything = [rich, of_memory("beaten", 4e6, 30.0), of_memory("?", math.nan, 99.0), lean]
    assert tradeoff.pareto(everything, cost="memory") == [lean, rich]


@pytest.mark.parametrize("least", [0.0, 2e5])
def test_memory_is_drawn_in_megabytes(least):
    ax = Figure().add_subplot()
    everything = [
        of_memory("a 1", least, 20.0),
        of_memory("a 2", math.nan, 25.0),
        of_memory("b", 3e6, 30.0),
    ]
    tradeoff.plot(everything, ax, lines={"a": ["a 1", "a 2"]}, cost="memory")
    assert ax.get_xlabel() == "memory beside arguments and image (MB)"
    assert ax.get_xscale() == ("symlog" if least == 0 else "log")
    assert [text.get_text() for text in ax.texts] == ["1", "b"]
    drawn = {tuple(xy) for line in ax.lines for xy in line.get_xydata()}
    assert drawn == {(least / 1e6, 20.0), (3.0, 30.0)}


POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), max_size=12)


@hyp.given(POINTS)
@hyp.settings(deadline=None)
def test_the_front_is_what_nothing_beats(pairs):
    everything = [point(i, float(s), float(p)) for i, (s, p) in enumerate(pairs)]
    front = tradeoff.pareto(everything)

    def beats(one, other):
        is_no_worse = one.seconds <= other.seconds and one.psnr >= other.psnr
        return is_no_worse and (one.seconds, one.psnr) != (other.seconds, other.psnr)

    unbeaten = {
        (m.seconds, m.psnr) for m in everything if not any(beats(o, m) for o in everything)
    }
    assert [(m.seconds, m.psnr) for m in front] == sorted(unbeaten)
    assert all(one in everything for one in front)


CHART = [
    point("passes 4", 0.004, 20.0),
    point("passes 16", 0.016, 25.0),
    point("scatter", 0.001, 24.0, spread=0.0004),
    point("loses", 0.1, 10.0, spread=0.02),
]


@pytest.fixture
def ax():
    ax = Figure().add_subplot()
    tradeoff.plot(CHART, ax, lines={"passes": ["passes 4", "passes 16"]})
    return ax


def test_every_method_is_drawn_and_named_the_losing_ones_too(ax):
    drawn = {tuple(xy) for line in ax.lines for xy in line.get_xydata()}
    assert {(1e3 * m.seconds, m.psnr) for m in CHART} <= drawn
    legend = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"passes", "Pareto front"} == set(legend)
    assert [text.get_text() for text in ax.texts] == ["4", "16", "scatter", "loses"]


def test_what_is_beaten_is_hollow(ax):
    hollow = {
        tuple(line.get_xydata()[0])
        for line in ax.lines
        if line.get_marker() in ("o", "s") and line.get_markerfacecolor() == "white"
    }
    assert hollow == {(4.0, 20.0), (100.0, 10.0)}


def test_the_front_is_drawn_through_the_unbeaten(ax):
    (front,) = (line for line in ax.lines if line.get_label() == "Pareto front")
    np.testing.assert_allclose(front.get_xydata(), [[1.0, 24.0], [16.0, 25.0]])


def test_axes_have_units_and_spreads_are_bars(ax):
    assert (ax.get_xlabel(), ax.get_xscale()) == ("time of an image (ms, median)", "log")
    assert ax.get_ylabel() == "PSNR to the reference (dB)"
    widths = {np.ptp(bar[:, 0]) for c in ax.collections for bar in c.get_segments()}
    np.testing.assert_allclose(sorted(widths), [0.0, 0.4, 20.0])


def test_names_keep_clear_of_one_another_and_of_points():
    """Twelve points that lie close together, as methods of one kind do."""
    rng = np.random.default_rng(3)
    crowd = [
        point(f"a method, {i} taps", 0.01 * 2**u, 30 + v)
        for i, (u, v) in enumerate(rng.random((12, 2)))
    ]
    figure = Figure(figsize=(7, 5))
    ax = figure.add_subplot()
    tradeoff.plot([*crowd, point("far", 1.0, 20.0)], ax)
    figure.draw_without_rendering()
    boxes = [Text.get_window_extent(text) for text in ax.texts]
    assert len(boxes) == 13
    for i, box in enumerate(boxes):
        assert all(Bbox.intersection(box, other) is None for other in boxes[:i])
        spots = ax.transData.transform([(1e3 * m.seconds, m.psnr) for m in crowd])
        assert not any(box.contains(*spot) for spot in spots)
        assert ax.bbox.containsx(box.x0) and ax.bbox.containsx(box.x1)
        assert Bbox.intersection(box, ax.get_legend().get_window_extent()) is None


def test_a_chart_is_saved_as_vectors_with_text_as_text(ax, tmp_path):
    for kind in ("svg", "pdf", "png"):
        tradeoff.save(ax.figure, tmp_path / f"chart.{kind}")
    svg = xml.etree.ElementTree.parse(tmp_path / "chart.svg")
    words = {"".join(e.itertext()) for e in svg.iter("{http://www.w3.org/2000/svg}text")}
    assert {"scatter", "loses", "PSNR to the reference (dB)"} <= words
    pdf = (tmp_path / "chart.pdf").read_bytes()
    # An embedded TrueType font; Type 3 is what publishers refuse.
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")


def test_saving_leaves_the_settings_alone_and_says_what_it_can_not(ax, tmp_path):
    before = dict(matplotlib.rcParams)
    with pytest.raises(
        ValueError, match=r"`save\(path\)` must end in one of .*'pdf'.*chart\.doc"
    ):
        tradeoff.save(ax.figure, tmp_path / "chart.doc")
    tradeoff.save(ax.figure, tmp_path / "chart.pdf")
    assert dict(matplotlib.rcParams) == before
    assert [path.name for path in tmp_path.iterdir()] == ["chart.pdf"]


def test_a_compiled_method_is_asked_and_not_compiled_again(monkeypatch):
    image = jnp.asarray(REFERENCE)
    program = (
        jax.jit(lambda x: jnp.sort(jnp.sort(x.ravel())[::-1] ** 2).reshape(x.shape))
        .lower(image)
        .compile()
    )
    monkeypatch.setattr(jax, "make_jaxpr", None)
    (found,) = measure({"a": functools.partial(program, image)}, repeats=1, memory=True)
    assert found.memory == program.memory_analysis().temp_size_in_bytes > 0


def test_memory_is_that_of_one_program():
    image = jnp.asarray(REFERENCE)
    side = REFERENCE.size

    def sorts():  # Two copies at least: neither can be had while the other is made.
        return jnp.sort(jnp.sort(image.ravel())[::-1] ** 2).reshape(REFERENCE.shape)

    def of_numpy():
        return REFERENCE

    def of_both():
        return jnp.asarray(np.asarray(image + 0))

    methods = {"sorts": sorts, "copies": lambda: image + 1, "numpy": of_numpy, "both": of_both}
    found = {one.name: one.memory for one in measure(methods, repeats=1, memory=True)}
    assert side * 8 <= found["sorts"] < 4 * side * 8
    assert found["copies"] == 0
    assert math.isnan(found["numpy"]) and math.isnan(found["both"])
    (unasked,) = measure({"sorts": sorts}, repeats=1)
    assert math.isnan(unasked.memory)
