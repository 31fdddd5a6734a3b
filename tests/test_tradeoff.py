"""The chart: what is measured is checked without a clock, the front against brute force."""

import inspect
import io
import math

import hypothesis as hyp
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxfx import metrics, tradeoff


RNG = np.random.default_rng(0)
REFERENCE = RNG.random((16, 20, 3))
PICTURES = {"close": REFERENCE + 0.01, "far": REFERENCE + 0.1 * RNG.random(REFERENCE.shape)}


class Method:
    """Gives its picture and counts its calls."""

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
    with pytest.raises(ValueError, match=r"\(16, 20, 3\), got \(16, 19, 3\) from 'wrong'"):
        call({"wrong": lambda: REFERENCE[:, 1:]}, REFERENCE, progress=False)


def point(name, seconds, psnr, spread=0.0):
    return tradeoff.Measurement(str(name), seconds, spread, psnr, 0.9, math.nan)


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
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"scatter", "loses", "passes", "Pareto front"} == set(labels)
    assert [text.get_text() for text in ax.texts] == ["4", "16"]


def test_the_front_is_drawn_through_the_unbeaten(ax):
    (front,) = (line for line in ax.lines if line.get_label() == "Pareto front")
    np.testing.assert_allclose(front.get_xydata(), [[1.0, 24.0], [16.0, 25.0]])


def test_axes_have_units_and_spreads_are_bars(ax):
    assert (ax.get_xlabel(), ax.get_xscale()) == ("time of a picture (ms, median)", "log")
    assert ax.get_ylabel() == "PSNR to the reference (dB)"
    widths = {np.ptp(bar[:, 0]) for c in ax.collections for bar in c.get_segments()}
    np.testing.assert_allclose(sorted(widths), [0.4, 20.0])


@pytest.mark.parametrize(("kind", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_chart_is_saved_as_vectors(ax, kind, start):
    buffer = io.BytesIO()
    ax.figure.savefig(buffer, format=kind)
    assert buffer.getvalue().startswith(start)
