"""Every method in every case in which methods fail, against the figures that are published.

A method may fail where its literature says so; it may not get worse. The cases are those of
`dof_cases.py`, whose output `failures.json` is, and which the notebook shows.
"""

import functools as ft
import json
import pathlib

import dof_cases
import pytest


PUBLISHED = json.loads((pathlib.Path(__file__).parent / "failures.json").read_text())
METHODS = dof_cases.methods()

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


def test_the_reference_passes_where_it_is_one():
    """Many passes over the same scenes give the closed forms, which are thereby checked."""
    measured = dof_cases.accumulated_figures()
    assert all(figure < 0.005 for figure in measured.values()), measured
    assert not worse_than_published(measured, PUBLISHED["accumulate"])
