"""A notebook is a pair: the script that is read and changed, and the outputs that are kept."""

import re
from pathlib import Path

import pytest


NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
PAIRS = sorted(path.stem for path in NOTEBOOKS.glob("*.py"))


def test_every_notebook_has_its_pair():
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")) == PAIRS


@pytest.mark.parametrize("name", PAIRS)
def test_a_pair_has_the_same_cells_and_outputs(name):
    jupytext = pytest.importorskip("jupytext", reason="pip install -e '.[notebook]'")
    script, notebook = (jupytext.read(NOTEBOOKS / f"{name}.{end}") for end in ("py", "ipynb"))
    cells = lambda book: [(cell.cell_type, cell.source.strip()) for cell in book.cells]
    assert cells(script) == cells(notebook), f"jupytext --sync notebooks/{name}.py"
    assert any(cell.get("outputs") for cell in notebook.cells)
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    assert re.match(r"What (none|.*(can't|cannot))", re.findall(r"^## (.*)", text, re.M)[-1])
