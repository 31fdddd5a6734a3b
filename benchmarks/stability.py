"""The stability atlas: every case in which methods fail, as one table with images.

`python -m benchmarks.stability` measures every case of `tests/cases`, or those of the effects
that it is given, and publishes them in `docs/stability`: for each effect a JSON file with what
each case asks and the figures of each method, and a sheet of thumbnails in the same order.
`--html FILE` writes a report of what is published, as `notebooks/stability.ipynb` shows it;
`--no-measure` writes only that.
"""

import argparse
import base64
import functools as ft
import html
import importlib
import io
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from PIL import Image
from tqdm.auto import tqdm

from jaxfx.io import srgb_from_linear


if TYPE_CHECKING:
    from tests.cases.registry import Case


EFFECTS = ("dof", "blur", "reproject", "shadow", "relight", "fit")
PUBLISHED = Path(__file__).parents[1] / "docs/stability"
TILE, ACROSS = 48, 16
KINDS = re.compile(r"\b(zero|biased|missing|none)\b")


class Published(NamedTuple):
    """A case as it was measured.

    Every figure is an error, 0 at best. `asks` has the bound of each figure, None where it is
    only watched; `gradients` says of each method how exact its derivatives are in this case;
    `figures` has those of each method. A case without methods was not measured, and `says` why.
    """

    effect: str
    name: str
    says: str
    asks: dict[str, float | None]
    gradients: dict[str, str]
    figures: dict[str, dict[str, float]]

    def passes(self, method: str) -> bool:
        """Whether all figures of a method are within their bounds."""
        bounds = ((self.asks[name], figure) for name, figure in self.figures[method].items())
        return all(bound is None or figure <= bound for bound, figure in bounds)


@ft.cache
def published(effect: str) -> dict[str, Published]:
    """The cases of an effect, by name."""
    cases = json.loads((PUBLISHED / f"{effect}.json").read_text(encoding="utf-8"))
    return {name: Published(effect, name, **case) for name, case in cases.items()}


def registered(effect: str) -> "list[Case]":
    """The cases of an effect as functions that measure, in the order of their file."""
    registry = importlib.import_module("tests.cases.registry")
    importlib.import_module(f"tests.cases.{effect}")
    return [case for case in registry.CASES if case.effect == effect]


def thumbnail(picture: Any) -> np.ndarray:
    """Linear values from 0 to 1 as a tile of bytes, in sRGB: the nearest pixel of the longer
    side's square; grey where there is no image, red where a value is not a number."""
    if picture is None:
        return np.full((TILE, TILE, 3), 235, np.uint8)
    picture = np.asarray(picture, float)
    picture = np.atleast_3d(picture) * np.ones(3)
    side = max(picture.shape[:2])
    y, x = (np.floor((np.arange(TILE) + 0.5) * side / TILE).astype(int) for _ in "yx")
    tile = np.full((side, side, 3), 1.0)
    tile[: picture.shape[0], : picture.shape[1]] = picture
    tile = tile[np.ix_(y, x)]
    bad = np.isnan(tile).any(axis=-1)
    tile = np.clip(np.nan_to_num(tile), 0, 1)
    curve = srgb_from_linear(tile)
    curve[bad] = (0.8, 0.1, 0.1)
    return np.round(255 * curve).astype(np.uint8)


@ft.cache
def tiles(effect: str) -> dict[tuple[str, str], np.ndarray]:
    """The published thumbnails of an effect by case and method."""
    sheet = np.asarray(Image.open(PUBLISHED / f"{effect}.png").convert("RGB"))
    rows = [
        (case.name, method) for case in published(effect).values() for method in case.figures
    ]
    corners = (divmod(index, ACROSS) for index in range(len(rows)))
    return {
        row: sheet[y * TILE : (y + 1) * TILE, x * TILE : (x + 1) * TILE]
        for row, (y, x) in zip(rows, corners, strict=True)
    }


def measure(effect: str) -> None:
    """Publish the cases and the thumbnails of an effect."""
    cases, sheet = {}, []
    for case in tqdm(registered(effect), desc=effect, mininterval=5):
        figures = {}
        for method in case.gradients:
            found = case.find(method)
            figures[method] = {name: float(f"{v:.3g}") for name, v in found.figures.items()}
            sheet.append(thumbnail(found.picture))
        cases[case.name] = {
            "says": case.says,
            "asks": case.asks,
            "gradients": case.gradients,
            "figures": figures,
        }
    sheet += [thumbnail(None)] * (-len(sheet) % ACROSS)
    lines = np.concatenate(sheet).reshape(-1, ACROSS, TILE, TILE, 3).swapaxes(1, 2)
    image = Image.fromarray(lines.reshape(-1, ACROSS * TILE, 3)).quantize(255)
    PUBLISHED.mkdir(exist_ok=True)
    image.save(PUBLISHED / f"{effect}.png", optimize=True)
    text = json.dumps(cases, indent=1, allow_nan=False)
    (PUBLISHED / f"{effect}.json").write_text(text + "\n", encoding="utf-8")
    published.cache_clear()
    tiles.cache_clear()


# The report.


def _img(picture: np.ndarray) -> str:
    """An image in the page itself."""
    file = io.BytesIO()
    Image.fromarray(picture).quantize(64).save(file, "png", optimize=True)
    text = base64.b64encode(file.getvalue()).decode()
    return f'<img src="data:image/png;base64,{text}" width="{picture.shape[1]}">'


def _framed(tile: np.ndarray) -> np.ndarray:
    """With a grey line on its right and below."""
    return np.pad(tile, ((0, 1), (0, 1), (0, 0)), constant_values=160)


def _who(some: list[str], of: dict[str, Any]) -> str:
    return "all" if some and len(some) == len(of) else html.escape("; ".join(some))


def _row(cells: list[str], tag: str = "td") -> str:
    return "<tr>" + "".join(f'<{tag} align="left">{cell}</{tag}>' for cell in cells) + "</tr>"


def _cell(figure: float | None, bound: float | None) -> str:
    if figure is None:
        return ""
    mark = "" if bound is None else " &#10003;" if figure <= bound else " <b>&#10007;</b>"
    return f"{figure:.2g}{mark}"


def table(case: Published) -> str:
    """A case as a table: a row for each method, with its image, figures and gradient."""
    title = f"<h4>{case.name}</h4><p>{html.escape(case.says)}</p>"
    if not case.figures:
        return title
    bounds = [
        f"{name}<br>{'watched' if bound is None else f'at most {bound:.3g}'}"
        for name, bound in case.asks.items()
    ]
    lines = []
    for method, figures in case.figures.items():
        cells = [_cell(figures.get(name), bound) for name, bound in case.asks.items()]
        tile = _img(_framed(tiles(case.effect)[case.name, method]))
        lines.append(
            _row([html.escape(method), tile, *cells, html.escape(case.gradients[method])])
        )
    head = _row(["method", "", *bounds, "derivatives"], "th")
    return f"{title}<table><thead>{head}</thead><tbody>{''.join(lines)}</tbody></table>"


def overview() -> str:
    """One row for each case: all its images, who fails, whose gradient is not exact."""
    lines = []
    for case in (case for effect in EFFECTS for case in published(effect).values()):
        fails = [method for method in case.figures if not case.passes(method)]
        kinds: dict[str, list[str]] = {}
        for method, gradient in case.gradients.items():
            for kind in dict.fromkeys(KINDS.findall(gradient)):
                kinds.setdefault(kind, []).append(method)
        small = [
            _framed(tiles(case.effect)[case.name, method][::2, ::2]) for method in case.figures
        ]
        count = len(case.figures)
        cells = [
            case.effect,
            case.name,
            _img(np.concatenate(small, axis=1)) if small else "",
            f"{count - len(fails)} of {count}" if count else "not measured",
            _who(fails, case.figures),
            "<br>".join(
                f"<b>{kind}</b>: {_who(who, case.figures)}" for kind, who in kinds.items()
            ),
        ]
        lines.append(_row(cells))
    head = _row(["effect", "case", "", "pass", "fail", "derivatives other than exact"], "th")
    return f"<table><thead>{head}</thead><tbody>{''.join(lines)}</tbody></table>"


def report() -> str:
    """Everything on one page."""
    parts = [f"<h3>{effect}</h3>{section(effect)}" for effect in EFFECTS]
    style = "<style>td, th { padding: 2px 8px; vertical-align: top; }</style>"
    return f"<!doctype html><meta charset=utf-8>{style}{overview()}{''.join(parts)}"


def section(effect: str) -> str:
    """All cases of one effect."""
    return "".join(table(case) for case in published(effect).values())


def main() -> None:
    """Measure, publish, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "effects", nargs="*", choices=[*EFFECTS, []], help="all, if none is named"
    )
    parser.add_argument("--html", type=Path, help="where to write the report")
    parser.add_argument("--no-measure", action="store_true", help="report what is published")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for effect in () if given.no_measure else given.effects or EFFECTS:
        measure(effect)
    if given.html:
        given.html.write_text(report(), encoding="utf-8")


if __name__ == "__main__":
    main()
