"""`python -m benchmarks.page`: the results page, `benchmarks/results/README.md`, written anew.

The tables and pictures that the other commands left in `benchmarks/results` enter; one page that
shows them all, each under the command that makes it, leaves.
"""

from benchmarks import RESULTS
from benchmarks.work_precision.problems import PROBLEMS

PAGE = RESULTS / "README.md"
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
    ("What a scene costs", "python -m benchmarks.cost", ("cost",)),
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
            yield from ("```text", table.read_text().rstrip(), "```", "")
        if picture.exists():
            yield from (f"![{title}: {name}]({picture.name})", "")


def page():
    """The whole page as text."""
    lines = ["# What was measured", "", "`python -m benchmarks.page` writes this page.", ""]
    for one in SECTIONS:
        lines += section(*one)
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page())
