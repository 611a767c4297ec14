"""Every outcome that a user may meet is one that some test meets."""

import ast

import pytest

from jaxfil import RESULTS
from tests import ROOT
from tests.problems import PROBLEMS

OUTCOMES = list(RESULTS._name_to_item)
# Those that no test meets, and why.
UNREACHED = {
    "orbit_lost": "It needs a flight that touches the surface and passes through it elsewhere. Of a "
    "flight with two dips, the search from the one that falls more slowly ends on another orbit.",
}


def asserted():
    """Names of outcomes in the assertions of tests: `RESULTS.name`, or the name in quotes in a list
    or a comparison. Unequal to an outcome is not met."""
    trees = {f: ast.parse(f.read_text()) for f in (ROOT / "tests").rglob("test_*.py")}
    for file, tree in trees.items():
        if file.name == "test_outcomes.py" and file.parent.name == "model":
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and any(isinstance(op, ast.NotEq) for op in node.ops):
                continue
            if isinstance(node, ast.Compare | ast.List | ast.Tuple | ast.Call | ast.Assign):
                for part in ast.iter_child_nodes(node):
                    if isinstance(part, ast.Attribute) and ast.unparse(part.value).endswith(
                        "RESULTS"
                    ):
                        yield part.attr
                    elif isinstance(part, ast.Constant):
                        yield part.value


def test_every_outcome_is_met_or_listed():
    met = {name for name in asserted() if name in OUTCOMES}
    met |= {problem.outcome for problem in PROBLEMS.values()}
    assert {*OUTCOMES} - met == {*UNREACHED}


@pytest.mark.parametrize("name", [name for name in OUTCOMES if name != "successful"])
def test_an_outcome_says_what_happened_and_ends_with_a_period(name):
    sentence = RESULTS[getattr(RESULTS, name)]
    assert len(sentence) > 30 and sentence[0].isupper() and sentence.endswith(".")
