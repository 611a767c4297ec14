"""What the site in docs/ promises: nothing that is public is left out. Its links are resolved by
`mkdocs build --strict` in `.ci/run`, and its scripts run in `test_examples`.
"""

import contextlib
import io
import re
import runpy
import textwrap
import types

import pytest

import jaxfil as jf
from tests import ROOT
from tests.project.repository import need
from tests.project.test_docstrings import CLASSES, FUNCTIONS, SYSTEMS, members
from tests.project.test_layout import project

need("docs")
DOCS = ROOT / "docs"
# A fenced block of Python, indented within a tab, and the text just below it, which it prints.
FENCED = re.compile(r"^( *)```python\n(.*?)^\1```\n(?:\s*^\1```text\n(.*?)^\1```)?", re.M | re.S)


def scripts(page):
    """The blocks of Python of a page in order, each with what the page says that it prints."""
    for indent, code, printed in FENCED.findall(page.read_text()):
        # What is printed may begin each line with blanks of its own: those of the fence go.
        yield textwrap.dedent(code), re.sub(f"^{indent}", "", printed, flags=re.M)


def lines(text):
    """Lines without the blanks at their ends."""
    return [line.rstrip() for line in text.strip().splitlines()]


def run(page, module):
    """Run the scripts of a page in a module."""
    for code, printed in scripts(page):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(code, page.name, "exec"), vars(module))
        assert lines(out.getvalue()) == lines(printed)


PAGES = {str(f.relative_to(DOCS)): f for f in sorted(DOCS.rglob("*.md")) if any(scripts(f))}


TABBED = """=== "tab"

    ```python
    print(1)
    ```

    ```text
    2
    ```
"""


def test_a_script_that_prints_something_else_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(TABBED)
    assert list(scripts(page)) == [("print(1)\n", "2\n")]
    with pytest.raises(AssertionError):
        run(page, types.ModuleType("page"))
    page.write_text(TABBED.replace("2\n", "1\n"))
    run(page, types.ModuleType("page"))


def test_every_block_is_closed_and_in_a_known_language():
    for page in DOCS.rglob("*.md"):
        fences = re.findall(r"^ *```(.*)", page.read_text(), re.M)
        # `py` is a file as it is, or a part of one.
        assert {*fences[::2]} <= {"python", "text", "bash", "yaml", "py", "matlab", "julia"}, page
        assert {*fences[1::2]} <= {""} and len(fences) % 2 == 0, page


def test_every_public_name_is_on_a_page_of_the_api():
    pages = "".join(f.read_text() for f in (DOCS / "api").glob("*.md"))
    shown = {*re.findall(r"^::: (\S+)", pages, re.M)}
    public = {
        *FUNCTIONS,
        *SYSTEMS,
        *CLASSES,
        "jaxfil.BIFURCATION_KINDS",
        "jaxfil.CODIMENSION_TWO_KINDS",
    }
    assert public - shown == set()


def test_the_page_of_outcomes_has_each_of_them_once():
    rows = re.findall(r"^\| `(\w+)` \|", (DOCS / "how-to/outcomes.md").read_text(), re.M)
    assert sorted(rows) == sorted(members(jf.RESULTS))


def test_every_picture_of_the_gallery_leads_to_its_code():
    text = (DOCS / "gallery.md").read_text()
    pictures = re.findall(r"^\[!\[.*\]\((\S+)\)\]\(#(\S+)\)$", text, re.M)
    assert len(pictures) == text.count("![")
    assert [picture for picture, _ in pictures if not (DOCS / picture).exists()] == []
    assert {code for _, code in pictures} <= {*re.findall(r"^::: (\S+)", text, re.M)}


def test_the_oldest_versions_supported_are_those_of_pyproject():
    table = (DOCS / "about/support.md").read_text()
    told = dict(re.findall(r"^\| (\w+) \| ([\d.]+) \|", table, re.M))
    asked = dict(re.fullmatch(r"(\w+)>=([\d.]+)", d).groups() for d in project()["dependencies"])
    asked["Python"] = project()["requires-python"].removeprefix(">=")
    assert told == asked


def test_the_drawings_are_drawn(tmp_path):
    runpy.run_path(str(DOCS / "drawings.py"))["theory"](tmp_path)
    assert {f.name for f in tmp_path.iterdir()} == {
        *("mechanisms.svg", "cases.svg", "intersection.svg", "flights.svg", "slides.svg")
    }
