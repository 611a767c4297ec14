"""Every measured number that README states is read out of the results files."""

import json
import re

import pytest

pytest.importorskip("benchmarks", reason="the sources of a release do not have them")

from benchmarks import RESULTS
from benchmarks.report import LEVELS, rate_at, ratios
from tests import ROOT
from tests.project.readme import README

WORDS = " ".join(README.split())
PAGE = " ".join((ROOT / "docs/results/index.md").read_text().split())
ROWS = json.loads((RESULTS / "throughput.json").read_text())["rows"]
RK4 = [("belt", "numba vector", "rk4", [1.1e-7]), ("sd", "numba vector", "rk4", [1e-8])]


def few(value, digits=2):
    """A number with so many digits, thousands with a comma: 1,370, 86, 2.0."""
    rounded = float(f"{value:.{digits}g}")
    decimals = 1 if rounded < 10 else 0
    return f"{rounded:,.{decimals}f}"


def span(values, digits=2):
    """The least and the largest: "2.0 to 5.5"."""
    return f"{few(min(values), digits)} to {few(max(values), digits)}"


def of(who, scenes=("belt", "sd"), inverse=False):
    """jaxfil's rate over a program's on one core, at every level; or the inverse."""
    found = ratios(ROWS)
    pairs = [p for scene in scenes for p in found[scene, who, 1].values() if None not in p]
    assert pairs
    return [b / a if inverse else a / b for a, b in pairs]


def by_method(scene, who, method, levels=LEVELS):
    """A method's rate over jaxfil's on one core at the levels that it reaches."""
    here = [r for r in ROWS if r["scene"] == scene]
    ours = [r for r in here if r["who"] == "jaxfil"]
    mine = [r for r in here if r["who"] == who and r["method"] == method]
    pairs = [(rate_at(mine, level, 1), rate_at(ours, level, 1)) for level in levels]
    return [a / b for a, b in pairs if a and b]


def beside_others(kind):
    """Run times of the fastest other program over jaxfil's, all problems and levels."""
    text = (RESULTS / "work_precision.txt").read_text()
    lines = re.findall(rf"^\w+ +{kind} {{2,}}([\d. ]+)$", text, re.M)
    assert len(lines) == 8
    return [float(word) for line in lines for word in line.split()]


def tried(pattern):
    """How many problems of these families and kinds were tried, and how many came out badly."""
    lines = re.findall(
        rf"^{pattern} {{2,}}([\d,]+) +[\d,]+ +[\d,]+ +([\d,]+) +[\d,]+ +([\d,]+) ",
        (RESULTS / "reliability.txt").read_text(),
        re.M,
    )
    return [sum(int(n.replace(",", "")) for n in column) for column in zip(*lines, strict=True)]


def over(values):
    """jaxfil's rate over that of a program, from the inverse: "0.6 to 0.8", or "2.9" alone."""
    ends = [f"{1 / v:.1f}" for v in (max(values), min(values))]
    return " to ".join(dict.fromkeys(ends))


def said():
    """The rows and sentences with numbers, as the results have them."""
    numba, cpp, scenes = "numba vector", "C++ vector", ("belt", "sd")
    for program, who, digits in (
        ("`Event` in a loop", "diffrax events", (3, 2)),
        ("with events", "SciPy events", (3, 3)),
        ("heyoka in batches", "heyoka", (2, 2)),
        ("numba, one lane at a time", "numba scalar", (2, 2)),
    ):
        belt, sd = (span(of(who, [s]), d) for s, d in zip(scenes, digits, strict=True))
        yield f"{program} | {belt} | {sd} |"
    # Of the shortest step of RK4, on belt friction that is for 1e-7.
    rk4 = [over(by_method(*row)) for row in RK4]
    dop = [over(by_method(scene, numba, "dop853")) for scene in scenes]
    yield f"RK4 (error 1e-7 for the belt, 1e-8 for SD) | {rk4[0]} | {rk4[1]} |"
    yield f"the same, DOP853 | {dop[0]} | {dop[1]} |"
    written = [over(of(cpp, [scene], inverse=True)) for scene in scenes]
    yield f"Taylor series | {written[0]} | {written[1]} |"
    one = beside_others("one lane")
    yield f"(usually heyoka) takes {min(one):.2g} to {max(one):.2g} times as long as jaxfil"
    yield f"On {tried('all')[0]:,} random problems with known answers, jaxfil never returned"


@pytest.mark.parametrize("sentence", tuple(said()))
def test_readme_says_what_was_measured(sentence):
    assert sentence in WORDS
    assert sentence in PAGE or "|" not in sentence  # the table stands on the site too


def test_none_was_wrong():
    assert tried("all")[1:] == [0, 0]
