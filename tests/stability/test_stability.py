"""Every method in every case in which methods fail, against its bounds.

The cases are those of `tests/cases`; `python -m benchmarks.stability` publishes their figures.
"""

import importlib.util
import math
import re

import numpy as np
import pytest

from benchmarks import stability


pytestmark = [pytest.mark.stability, pytest.mark.usefixtures("optimised")]

CASES = {effect: stability.registered(effect) for effect in stability.EFFECTS}

# Cases share the programs of their methods: all of one group are measured by one process.
GROUPS: dict[str, list] = {}
for effect, cases in CASES.items():
    for case in cases:
        for method in case.gradients:
            shared = method.partition(",")[0] if effect == "dof" else case.name
            GROUPS.setdefault(f"{effect}: {shared}", []).append((case, method))

# What no method may get wrong, whatever else it gets wrong.
NEVER = {
    "dof": ("constant image", "float32", "float64", "energy", "not finite"),
    "blur": ("inside", "change", "gradient", "other channels"),
    "reproject": ("image", "alpha"),
    "shadow": ("pixels",),
}

# How far a figure that fails or is only watched may lie above the published one. Such a figure
# may rest on difference quotients across a kink, whose last digits are the code generator's.
MARGIN = 1.5


def limit(bound, published):
    """The bound of a figure that met it when it was published; a margin for any other."""
    if bound is not None and published <= bound:
        return bound
    return max(MARGIN * published, 1e-9)


@pytest.mark.parametrize("group", GROUPS)
def test_figures_are_within_their_bounds(group):
    above = {}
    for case, method in GROUPS[group]:
        if case.needs and importlib.util.find_spec(case.needs) is None:
            pytest.skip(f"{case.name} needs {case.needs}, which comes with the `bench` extra.")
        figures = case.find(method).figures
        published = stability.published(case.effect)[case.name].figures[method]
        assert figures.keys() == published.keys() <= case.asks.keys(), (case.name, method)
        for name, figure in figures.items():
            most = limit(case.asks[name], published[name])
            if not figure <= most:
                above[case.name, method, name] = (figure, most)
    assert not above


@pytest.mark.parametrize("effect", stability.EFFECTS)
def test_what_is_published_is_what_is_registered(effect):
    published = stability.published(effect)
    assert [*published] == [case.name for case in CASES[effect]]
    for case in CASES[effect]:
        row = published[case.name]
        assert (row.says, row.asks, row.gradients) == (case.says, case.asks, case.gradients)
        assert [*row.figures] == [*case.gradients]
        for method, figures in row.figures.items():
            assert all(math.isfinite(figure) and figure >= 0 for figure in figures.values())
            for name in set(figures) & set(NEVER.get(effect, ())):
                assert figures[name] <= case.asks[name], (case.name, method, name)


@pytest.mark.parametrize("effect", stability.EFFECTS)
def test_a_derivative_that_is_off_is_not_called_exact(effect):
    for case in stability.published(effect).values():
        for method, said in case.gradients.items():
            assert re.match(r"(exact|zero|biased|missing|none)\b", said), (case.name, method)
            off = case.figures[method].get("gradient", 0.0)
            if case.asks.get("gradient") is not None and off > case.asks["gradient"]:
                assert not said.startswith("exact"), (case.name, method, off)


def test_the_report_shows_every_row():
    page = stability.report()
    for effect in stability.EFFECTS:
        shown, cases = stability.section(effect), stability.published(effect).values()
        assert shown in page
        rows = sum(len(case.figures) for case in cases)
        heads = sum(bool(case.figures) for case in cases)
        assert shown.count("<img") == rows == shown.count("</tr>") - heads
        assert all(case.name in shown for case in cases)


def test_a_thumbnail_has_one_pixel_for_each_of_a_small_image():
    picture = np.zeros((12, 16))
    picture[3, 5], picture[11, 15] = 1, np.nan
    tile = stability.thumbnail(picture)
    assert tile.shape == (48, 48, 3)
    assert (tile[9:12, 15:18] == 255).all() and (tile[:9, :15] == 0).all()
    assert (tile[33:36, 45:48] == (204, 26, 26)).all()
    assert (tile[36:] == 255).all()
