"""Every method in every case in which methods fail, against the figures that are published.

A method may fail where its literature says so; it may not get worse. The cases are those of
`tests/benchmarks/*_failures.py`; `tests/benchmarks/stability_atlas.py` publishes the figures.
"""

import importlib.util
import math
import re

import numpy as np
import pytest
import stability_atlas as stability


pytestmark = pytest.mark.stability

# Cases share the programs of their methods: all of one group are found by one process.
GROUPS: dict[str, list] = {}
for effect in stability.EFFECTS:
    for case, method in stability.rows(effect):
        shared = method.partition(",")[0] if effect == "dof" else case.name
        GROUPS.setdefault(f"{effect}: {shared}", []).append((case, method))

# What no method may get wrong, whatever else it gets wrong.
NEVER = {
    "dof": ("constant image", "float32", "float64", "energy", "not finite"),
    "blur": ("inside", "change", "gradient", "other channels"),
    "reproject": ("image", "alpha"),
    "shadow": ("pixels",),
}


def limit(bound, published):
    """A figure that passes may vary within its bound, none if that is 0; another by a fiftieth,
    or rounding."""
    return max(1.02 * published, 1e-9 if bound is None else bound)


@pytest.mark.parametrize("group", GROUPS)
def test_no_figure_is_worse_than_published(group):
    worse = {}
    for case, method in GROUPS[group]:
        if case.needs and importlib.util.find_spec(case.needs) is None:
            pytest.skip(f"{case.name} needs {case.needs}, which comes with the `bench` extra.")
        figures = case.find(method).figures
        published = stability.published(case.effect)[case.name][method]
        assert figures.keys() == published.keys() <= case.asks.keys(), (case.name, method)
        for name, figure in figures.items():
            if not figure <= limit(case.asks[name], published[name]):
                worse[case.name, method, name] = (figure, published[name])
    assert not worse, "better? then publish: python tests/benchmarks/stability_atlas.py"


@pytest.mark.parametrize("effect", stability.EFFECTS)
def test_what_is_published_is_what_is_registered(effect):
    published = stability.published(effect)
    expected = {}
    for case, method in stability.rows(effect):
        expected.setdefault(case.name, []).append(method)
    assert {name: [*found] for name, found in published.items() if found} == expected
    for case, method in stability.rows(effect):
        figures = published[case.name][method]
        assert all(math.isfinite(figure) and figure >= 0 for figure in figures.values())
        for name in set(figures) & set(NEVER.get(effect, ())):
            assert figures[name] <= case.asks[name], (case.name, method, name)


@pytest.mark.parametrize("effect", stability.EFFECTS)
def test_a_derivative_that_is_off_is_not_called_exact(effect):
    for case, method in stability.rows(effect):
        said = case.gradients[method]
        assert re.match(r"(exact|zero|biased|missing|none)\b", said), (case.name, method)
        off = stability.published(effect)[case.name][method].get("gradient", 0.0)
        if case.asks.get("gradient") is not None and off > case.asks["gradient"]:
            assert not said.startswith("exact"), (case.name, method, off)


def test_the_report_shows_every_row():
    page = stability.report()
    for effect in stability.EFFECTS:
        shown = stability.section(effect)
        assert shown in page
        assert (
            shown.count("<img")
            == len(stability.rows(effect))
            == shown.count("</tr>")
            - sum(
                case.effect == effect and bool(case.gradients) for case in stability.registry()
            )
        )
        assert all(case.name in shown for case, _ in stability.rows(effect))


def test_a_thumbnail_has_one_pixel_for_each_of_a_small_picture():
    picture = np.zeros((12, 16))
    picture[3, 5], picture[11, 15] = 1, np.nan
    tile = stability.thumbnail(picture)
    assert tile.shape == (48, 48, 3)
    assert (tile[9:12, 15:18] == 255).all() and (tile[:9, :15] == 0).all()
    assert (tile[33:36, 45:48] == (204, 26, 26)).all()
    assert (tile[36:] == 255).all()
