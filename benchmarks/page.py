"""`python -m benchmarks.page`: the results pages in `benchmarks/results`, written anew.

The tables and pictures that the other commands left in `benchmarks/results` enter; a page that
shows them all, each under the command that makes it, leaves as `README.md`, and for each figure of
the paper a page that puts the paper's panels beside ours, as `fig4.md`. A table longer
than a screen is folded.
"""

import itertools
import re

import numpy as np

from benchmarks import RESULTS
from benchmarks.paper.captions import CAPTIONS
from benchmarks.paper.table import WIDTHS
from benchmarks.work_precision.problems import PROBLEMS

PAGE = RESULTS / "README.md"
# Lines that a screen shows.
SCREEN = 40
# Title, command, and the names of its results: NAME.txt is shown as it is, NAME.png as a picture.
SECTIONS = (
    ("What it draws", "python -m benchmarks.gallery", ("gallery",)),
    (
        "Error against throughput, beside other programs",
        "python -m benchmarks.throughput",
        ("throughput",),
    ),
    (
        "Work against precision on eight problems, beside other programs",
        "python -m benchmarks.work_precision",
        ("work_precision", *(f"work_precision_{name}" for name in PROBLEMS)),
    ),
    (
        "A tolerance instead of a step: what is chosen, and its true error",
        "python -m benchmarks.step_choice",
        ("step_choice",),
    ),
    (
        "Sweeps by power series beside Dopri8",
        "python -m benchmarks.taylor",
        ("taylor",),
    ),
    (
        "Fixed steps and a tolerance where steps must vary by orders",
        "python -m benchmarks.varying",
        ("varying",),
    ),
    (
        "Friction and restitution from noisy measurements, beside SciPy",
        "python -m benchmarks.fit",
        ("fit",),
    ),
    ("What a scene costs", "python -m benchmarks.cost", ("cost",)),
    ("On a GPU, beside the CPU", "python -m benchmarks.accelerator", ("accelerator",)),
    (
        "Thousands of random problems against independent answers",
        "python -m benchmarks.reliability",
        ("reliability",),
    ),
    ("Far outside the usual", "python -m benchmarks.extremes", ("extremes",)),
    ("Stiff scenes", "python -m benchmarks.stiff", ("stiff", "stability")),
    ("Lyapunov exponents: what smoothing does", "python -m benchmarks.lyapunov", ("lyapunov",)),
    (
        "Bifurcations of the paper, and a search by gradient",
        "python -m benchmarks.bifurcations",
        ("bifurcations",),
    ),
    (
        "Figures of Santhosh, Narayanan and Padmanabhan (2016)",
        "python -m benchmarks.paper",
        ("fig4", "fig5", "fig6", "fig8", "fig9", "fig10", "fig11", "section5"),
    ),
)


def section(title, command, names):
    """The lines of one section."""
    yield from (f"## {title}", "", f"`{command}`", "")
    for name in names:
        table, picture = RESULTS / f"{name}.txt", RESULTS / f"{name}.png"
        if not table.exists() and not picture.exists():
            raise FileNotFoundError(f"neither {table} nor {picture}: run `{command}` first")
        if table.exists():
            yield from folded(name, table.read_text().rstrip())
        if picture.exists():
            yield from (f"![{title}: {name}]({picture.name})", "")
        if name in CAPTIONS:
            yield from (f"[Panel by panel]({name}.md), [PDF]({name}.pdf)", "")


def folded(name, text):
    """A table, to be opened by a click if it is long."""
    block = ("```text", text, "```", "")
    if (length := text.count("\n")) < SCREEN:
        yield from block
    else:
        summary = f"<summary>{name}.txt, {length + 1} lines</summary>"
        yield from ('<details markdown="1">', summary, "", *block, "</details>", "")


def index():
    """A line for each section, with a link."""
    for title, command, _ in SECTIONS:
        anchor = re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
        yield f"- [{title}](#{anchor}): `{command}`"


def page():
    """The whole page as text."""
    lines = ["# What was measured", "", "`python -m benchmarks.page` writes this page.", ""]
    lines += [*index(), ""]
    for one in SECTIONS:
        lines += section(*one)
    return "\n".join(lines)


def figure_page(name):
    """The page of one figure of the paper as text."""
    about, panels = CAPTIONS[name]
    title = name.replace("fig", "Fig. ").replace("section", "Section ")
    lines = [f"# {title} of Santhosh, Narayanan and Padmanabhan (2016): {about}", ""]
    lines += [f"`python -m benchmarks.paper {name}` makes it; also as [PDF]({name}.pdf).", ""]
    lines += [f"![{title}]({name}.png)", "", "| panel | in the paper | here |", "|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in panels]
    lines += ["", *rows_of((RESULTS / f"{name}.txt").read_text())]
    why = "All differences: [where jaxfil and the paper differ](../../docs/theory/paper.md)."
    return "\n".join([*lines, "", why, ""])


def rows_of(text):
    """A table of `benchmarks.paper.table` as lines of Markdown: cells that wrap are joined."""
    edges = np.cumsum([0, *(width + 2 for width in WIDTHS.values())])
    _, _, headings, _, *body = text.splitlines()
    rows = []
    for line in (headings, *body):
        cells = [line[i:j].rstrip() for i, j in itertools.pairwise(edges)]
        if cells[0]:
            rows.append([cell.replace("  ", "&emsp;") for cell in cells])
        else:  # the line before goes on
            rows[-1] = [f"{a} {b.strip()}".strip() for a, b in zip(rows[-1], cells, strict=True)]
    head, *rows = (f"| {' | '.join(row)} |" for row in rows)
    return [head, "|" + "---|" * len(WIDTHS), *rows]


def pages():
    """Every page by its file."""
    return {PAGE: page()} | {RESULTS / f"{name}.md": figure_page(name) for name in CAPTIONS}


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
