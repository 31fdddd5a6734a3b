"""Every method in every case in which methods fail, against the figures that are published.

A method may fail where its literature says so; it may not get worse. The cases are those of
`dof_cases.py`, whose output `failures.json` is, and which the notebook shows.
"""

import functools as ft
import json
import pathlib

import dof_cases
import numpy as np
import pytest

from jaxfx import FocusPlanes, ThinLens


PUBLISHED = json.loads((pathlib.Path(__file__).parent / "failures.json").read_text())
METHODS = dof_cases.methods()

CASES = [
    (ThinLens(0.2, 2.5, 60.0), (13, 11)),
    (FocusPlanes(near=1.0, focus=2.5, far=7.0, max_coc=6.0), (1, 17)),
]

# What the page asks of every method, whatever else it gets wrong.
NEVER = ("constant", "energy", "not finite")


@ft.cache
def figures(name):
    return dof_cases.figures(METHODS[name])


def worse_than_published(measured, published):
    """A passed case may vary by its rounding, a failed one by a fiftieth."""
    return {
        case: (figure, published[case])
        for case, figure in measured.items()
        if not figure <= max(dof_cases.PASSES[case], 1.02 * published[case])
    }


@pytest.mark.parametrize("name", METHODS)
def test_no_method_is_worse_than_published(name):
    assert name in PUBLISHED, "publish it: python tests/benchmarks/dof_cases.py"
    assert PUBLISHED[name].keys() == dof_cases.PASSES.keys()
    assert not worse_than_published(figures(name), PUBLISHED[name])


@pytest.mark.parametrize("name", METHODS)
def test_what_no_method_may_get_wrong(name):
    wrong = {case: figures(name)[case] for case in NEVER}
    assert all(figure <= dof_cases.PASSES[case] for case, figure in wrong.items()), wrong


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("lens", "size"), CASES, ids=["thin lens", "focus planes"])
def test_a_constant_image_is_kept_to_rounding(name, lens, size):
    depth = np.random.default_rng(0).uniform(0.5, 9, size)
    depth[..., :2], depth[-1, -1] = np.inf, 1e-30
    out = METHODS[name](np.full((*size, 2), 0.7), depth, lens, max_coc=6.0)
    assert np.abs(out - 0.7).max() < 1e-12


def test_the_reference_passes_where_it_is_one():
    """Many passes over the same scenes give the closed forms, which are thereby checked."""
    measured = dof_cases.accumulated_figures()
    assert all(figure < 0.005 for figure in measured.values()), measured
    assert not worse_than_published(measured, PUBLISHED["accumulate"])
