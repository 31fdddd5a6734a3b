"""Bars: none unless asked for, and an extra is named where tqdm is missing."""

import inspect
import sys

import jax.numpy as jnp
import pytest

from jaxfx import PinholeCamera, ThinLens, dof, fit, tradeoff
from jaxfx._progress import Bar, counted


def test_without_a_bar_nothing_is_shown_or_imported(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with Bar(False, "fit") as bar:
        bar.step(mse="1")
    assert list(counted(range(3), False, "lens")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")


def test_a_bar_counts_and_shows_figures(capsys):
    with Bar(True, "fit") as bar:
        for _ in range(3):
            bar.step(mse="0.125")
    assert list(counted(range(3), True, "lens")) == [0, 1, 2]
    shown = capsys.readouterr().err
    assert "fit: 3step" in shown and "mse=0.125" in shown
    assert "lens" in shown and "/3" in shown


def test_a_missing_tqdm_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    for call in (lambda: Bar(True, "fit"), lambda: counted([], True, "lens")):
        with pytest.raises(ImportError, match=r"pip install 'jaxfx\[plot\]'"):
            call()


CALLS = [fit.dof, fit.lights, fit.camera, tradeoff.measure, dof.accumulate]


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
def test_every_call_is_silent_by_default(call):
    assert inspect.signature(call).parameters["progress"].default is False


def test_what_is_asked_for_is_shown(capsys):
    image = jnp.ones((8, 8, 1))
    camera = PinholeCamera.from_fov(0.8, height=8, width=8)
    data = lambda eye: image, camera, ThinLens(0.1, 2.0, 10.0)
    for progress in (False, True):
        dof.accumulate(*data, samples=2, progress=progress)
        tradeoff.measure({"it": lambda: image}, image, memory=False, progress=progress)
        shown = capsys.readouterr().err
        assert ("lens" in shown, "measure" in shown) == (progress, progress)
