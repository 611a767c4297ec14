"""Every outcome that a user may meet is one that some test meets."""

import ast

import numpy as np
import pytest

from jaxfil import RESULTS
from jaxfil.model.outcomes import code, outcomes
from tests import ROOT
from tests.problems import PROBLEMS

OUTCOMES = list(RESULTS._name_to_item)
# Those that no test meets, and why.
UNREACHED: dict[str, str] = {}


def asserted():
    """Names of outcomes that tests compare with or list: `RESULTS.name`, or the name in quotes. To
    be unequal to an outcome is not to meet it."""
    trees = {f: ast.parse(f.read_text()) for f in (ROOT / "tests").rglob("test_*.py")}
    for file, tree in trees.items():
        if file.name == "test_outcomes.py" and file.parent.name == "model":
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and any(isinstance(op, ast.NotEq) for op in node.ops):
                continue
            if isinstance(node, ast.Compare | ast.List | ast.Tuple | ast.Call | ast.Assign):
                yield from map(named, ast.iter_child_nodes(node))


def named(node):
    """The outcome that an expression names, perhaps."""
    if isinstance(node, ast.Attribute) and ast.unparse(node.value).endswith("RESULTS"):
        return node.attr
    return node.value if isinstance(node, ast.Constant) else None


def test_every_outcome_is_met_or_listed():
    met = {name for name in asserted() if name in OUTCOMES}
    met |= {problem.outcome for problem in PROBLEMS.values()}
    assert {*OUTCOMES} - met == {*UNREACHED}


@pytest.mark.parametrize("name", [name for name in OUTCOMES if name != "successful"])
def test_an_outcome_says_what_happened_and_ends_with_a_period(name):
    sentence = RESULTS[getattr(RESULTS, name)]
    assert len(sentence) > 30 and sentence[0].isupper() and sentence.endswith(".")


def test_names_of_lanes_are_indexed_and_counted():
    codes = [code(RESULTS.zeno), code(RESULTS.successful), code(RESULTS.zeno)]
    results = outcomes(np.array([codes, codes], np.int32))
    names = RESULTS.names(results)
    assert names.shape == (2, 3) and names[1, 1] == "successful" and names[0, 2] == "zeno"
    assert (names == "zeno").sum() == int((results == RESULTS.zeno).sum()) == 4
    assert RESULTS.names(RESULTS.nonfinite) == "nonfinite"
