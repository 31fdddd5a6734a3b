"""The documentation: the code of its pages runs, and the checks of the site see errors."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxfx


DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("index", "lenses", "recipes", "pytorch", "relight")
NEEDS = {"pytorch": "torch"}

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def build():
    pytest.importorskip("nbformat", reason="pip install -e '.[docs]'")
    spec = importlib.util.spec_from_file_location("build_docs", DOCS / "build.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def scripts():
    """What a reader would copy into a file: a recipe alone, of other pages all blocks."""
    for page in PAGES:
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        alone = blocks if page == "recipes" else ["\n".join(blocks)]
        for number, code in enumerate(alone):
            yield pytest.param(page, code, id=f"{page}-{number}")


@pytest.mark.parametrize(("page", "code"), list(scripts()))
def test_the_code_of_a_page_runs(page, code, tmp_path):
    if page in NEEDS:
        pytest.importorskip(NEEDS[page], reason=f"{NEEDS[page]} is not installed")
    assert "import" in code
    path = tmp_path / f"{page}.py"
    path.write_text(code, encoding="utf-8")
    command = [sys.executable, str(path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_public_name_is_in_the_reference(build):
    places = build.anchors()
    for module in build.MODULES:
        text = build.reference(module, places)
        for name in build.public(module):
            assert f"{{ #{name.lower()} }}" in text
    assert set(jaxfx._MODULES) == set(build.MODULES) - {"jaxfx"}


def test_every_function_with_a_gradient_line_is_in_the_table(build):
    table = build.gradients({})
    for call in ("dof.scatter", "reproject.warp", "shadow.pcf", "relight.render", "ThinLens"):
        assert f"| `{call}` |" in table
    assert table.count("\n| `") > 60


def test_names_lead_to_the_reference_and_code_does_not(build):
    places = {"dof.scatter": "api/dof.md#scatter"}
    text = "`dof.scatter(image)`, `other`, [`dof.scatter`](x.md)\n```python\n`dof.scatter`\n```"
    link = "[`dof.scatter(image)`](../api/dof.md#scatter)"
    assert build.linked(text, "../", places) == text.replace("`dof.scatter(image)`", link)


def test_an_example_becomes_a_block(build):
    text = "Words.\n\n    >>> 1 + 1\n    2\n\n    More."
    assert build.fenced(text) == "Words.\n\n```pycon\n>>> 1 + 1\n2\n```\n\nMore."


def test_a_formula_becomes_mathml_and_code_does_not(build):
    out = build.with_formulas("Of $x^2$ and `$y$`.")
    assert out.startswith("Of <math") and "<msup><mi>x</mi><mn>2</mn></msup>" in out
    assert out.endswith("`$y$`.")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<a href="b.html">b</a>', "link to b.html, which does not exist"),
        ('<a href="#there">b</a>', "link to #there, whose anchor does not exist"),
        ('<img src="a.png">', "image a.png has no alternative text"),
        ('<img src="a.png" alt="a">', "a.png is missing"),
        (
            '<script src="https://x.org/a.js"></script>',
            "loads https://x.org/a.js from the network",
        ),
        ("x" * 1_500_001, "1.50 MB with all that it loads"),
        ('<p id="here"><a href="#here">a</a>', None),
    ],
)
def test_what_is_wrong_with_a_page_is_said(build, tmp_path, monkeypatch, body, message):
    monkeypatch.setattr(build, "SITE", tmp_path)
    (tmp_path / "a.html").write_text(body, encoding="utf-8")
    expected = [f"a.html: {message}"] if message else []
    found = build.problems()
    assert [line for line in found if line in expected] == expected
    assert message or not found
