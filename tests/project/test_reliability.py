"""The program that counts how often jaxfil is right: it runs, with few systems, and tells."""

import pytest

pytest.importorskip("benchmarks", reason="the sources of a release do not have them")

from benchmarks.reliability import cases, faults
from benchmarks.reliability.__main__ import main, report
from benchmarks.reliability.verdict import Group, Verdict


@pytest.mark.release
@pytest.mark.parametrize("family", ["relays", "impacts", "smooth"])
def test_few_systems_come_out_right(family):
    (group,) = main(["--systems", "20", "--only", family])
    assert {v.kind for v in group.verdicts} == {"right"} and len(group.verdicts) == 5


@pytest.mark.release
def test_derivatives_of_few_systems_come_out_right():
    (group,) = main(["--systems", "20", "--only", "derivatives"])
    assert {v.kind for v in group.verdicts} == {"right"}


@pytest.mark.slow
def test_a_case_is_right_and_another_is_told():
    kick, two_fold = cases.resets()[0], cases.ends()[0]
    assert cases.judge(kick).kind == "right" and cases.judge(two_fold).kind == "told"
    assert cases.judge(kick._replace(end=(0, 0))).kind == "wrong"
    assert cases.judge(two_fold._replace(outcome="successful")).kind == "refused"


@pytest.mark.release
def test_a_killed_sweep_is_taken_up_again():
    assert faults.judge(faults.killed, faults.uninterrupted()).kind == "right"


def test_what_is_wrong_is_named_below_the_table():
    verdicts = [
        Verdict(0, "right", error=1e-12),
        Verdict(7, "wrong", "error 1.0"),
        Verdict(8, "told"),
    ]
    text = report([Group("relays", "2 states", verdicts)], seed=3)
    assert "seed 3" in text and "relays, 2 states, system 7: WRONG, error 1.0" in text
    row = next(line for line in text.splitlines() if line.startswith("relays  "))
    assert row.split()[3:] == ["3", "1", "1", "0", "0", "1", "1.0e-12"]
