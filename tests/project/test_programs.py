"""The programs that `benchmarks.work_precision` sets beside each other: each one is right.

References: closed forms and Taylor series in long double, named in its file of problems.
"""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("benchmarks", reason="the sources of a release do not have them")

from benchmarks.work_precision import (
    diffrax_events,
    front,
    heyoka_events,
    ours,
    picture,
    saved,
    scipy_events,
    smoothed,
)
from benchmarks.work_precision.__main__ import text
from benchmarks.work_precision.measure import Row, rows
from benchmarks.work_precision.problems import PROBLEMS
from benchmarks.work_precision.program import spread

NAMES = list(PROBLEMS)


def reaches(name, run, atol):
    assert int(run.contacts) == PROBLEMS[name].contacts
    assert_allclose(run.x, PROBLEMS[name].reference, atol=atol, rtol=0)


def single(program, name, method):
    """The curve of one lane."""
    curves = program.curves(PROBLEMS[name])
    return next(c for c in curves if c.method == method and c.lanes == 1)


@pytest.mark.parametrize("name", NAMES)
def test_scipy_reaches_the_reference(name):
    reaches(name, single(scipy_events, name, "DOP853").build(1e-13)(), 1e-11)


@pytest.mark.parametrize(("method", "atol"), [("RK45", 1e-9), ("Radau", 1e-5), ("LSODA", 1e-9)])
def test_every_method_of_scipy_reaches_the_reference(method, atol):
    rtol = 1e-5 if method == "Radau" else 1e-11
    reaches("impact", single(scipy_events, "impact", method).build(rtol)(), atol)


@pytest.mark.skipif(bool(heyoka_events.missing()), reason="heyoka is not installed")
@pytest.mark.parametrize("name", NAMES)
def test_heyoka_reaches_the_reference(name):
    reaches(name, single(heyoka_events, name, "Taylor").build(1e-15)(), 2e-13)


@pytest.mark.skipif(bool(heyoka_events.missing()), reason="heyoka is not installed")
@pytest.mark.parametrize("name", [n for n in NAMES if "long double at" in PROBLEMS[n].source])
def test_a_reference_is_what_heyoka_finds_in_long_double(name):
    made = heyoka_events.integrators(PROBLEMS[name], 1e-18, np.longdouble)
    reaches(name, heyoka_events.follow(PROBLEMS[name], made, np.longdouble), 1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rotating", "moving_belt", "impact"])
def test_diffrax_reaches_the_reference(name):
    reaches(name, single(diffrax_events, name, "Tsit5").build(1e-12)(), 1e-10)


def test_jaxfil_reaches_the_reference():
    reaches("moving_belt", single(ours, "moving_belt", "Dopri8").build(0.03)(), 1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_jaxfil_solves_the_same_problem(name):
    problem, (system, _) = PROBLEMS[name], ours.scenes()[name]
    points = np.random.default_rng(0).uniform([0, -0.3, -0.3], [9, 0.9, 0.9], (8, 3))
    for t, *x in points:
        assert_allclose(system.switching(t, jnp.asarray(x)), problem.height(t, x, math), rtol=1e-13)
        for side in (1, -1):
            field = system.vector_field(t, jnp.asarray(x), jnp.asarray(float(side)))
            assert_allclose(field, problem.field(t, x, side, math), rtol=1e-12, atol=1e-13)


def test_smoothing_stops_at_an_error_of_the_size_of_the_width():
    problem = PROBLEMS["slip_stick"]
    wide, narrow = list(smoothed.curves(problem))[:2]
    assert "1e-02" in wide.method and "1e-03" in narrow.method
    ends = [np.asarray(curve.build(1e-8)().x) for curve in (wide, narrow)]
    first, second = (np.abs(end - problem.reference).max() for end in ends)
    assert 1e-3 < first < 1 and 0.03 < second / first < 0.3


def test_a_batch_begins_at_the_problem_and_near_it():
    starts = spread((0.3, 0.1), 5)
    assert starts.shape == (5, 2) and starts[0].tolist() == [0.3, 0.1]
    assert len({tuple(s) for s in starts}) == 5 and np.abs(starts - starts[0]).max() < 1.1e-3


def row(program, method, error, seconds, lanes=1, contacts=10):
    return Row(program, method, lanes, 1.0, "dt", error, seconds, 0.0, contacts, 100)


MEASURED = [
    row("jaxfil", "Dopri8", 1e-5, 1e-3),
    row("jaxfil", "Dopri8", 1e-9, 4e-3),
    row("heyoka", "Taylor", 1e-3, 1e-4),
    row("heyoka", "Taylor", 1e-7, 1e-2),
    row("jaxfil", "Dopri8", 1e-5, 1e-5, lanes=256),
    row("smoothed", "Tsit5, width 1e-02", 2e-3, 1e-2),
    row("smoothed", "Tsit5, width 1e-02", 1.99e-3, 3e-2),
    row("diffrax", "Tsit5", math.nan, 1e-5),
]


def test_rows_are_read_back_from_their_table():
    more = [row("SciPy", "Radau", 2.5e-7, 1.234, contacts=4), *MEASURED]
    written = "\n" + text("slip_stick", more, ["heyoka skipped: not here"])
    kept = [r._replace(contacts=0) if r.program == "smoothed" else r for r in more]
    back = saved.rows(written, "slip_stick")
    assert [r[:5] for r in back] == [r[:5] for r in kept]
    assert_allclose(np.array([r[5:] for r in back]), np.array([r[5:] for r in kept]), rtol=6e-3)


def test_who_is_in_front_is_read_between_the_settings():
    plain = front.contests(MEASURED)["one lane"]
    # Half way between 1e-5 and 1e-9 on logarithmic axes; above the cheapest setting that one's.
    ours_, heyoka = (front.curves(plain)[k] for k in (("jaxfil", "Dopri8"), ("heyoka", "Taylor")))
    assert_allclose(front.seconds_at(ours_, 1e-7), 2e-3)
    assert_allclose(front.seconds_at(ours_, 1e-2), 1e-3)
    assert front.seconds_at(ours_, 1e-10) == math.inf
    assert_allclose(front.seconds_at(heyoka, 1e-5), 1e-3)
    assert_allclose(front.ratio(plain, 1e-4), 10**-0.5 * 1e-3 / 1e-3)
    told = list(front.lines(MEASURED))
    assert told[1].startswith("  at 1e-04 no, fastest is heyoka Taylor (0.32 ms), then jaxfil")
    assert (
        told[2] == "  at 1e-06 yes, fastest is jaxfil Dopri8 (1.4 ms), then heyoka Taylor (3.2 ms)"
    )
    assert told[4] == "  at 1e-10 nobody gets there" and "steps of 1e+02 µs" in told[5]
    assert "a lane of a batch" in told[6] and told[7].startswith("  at 1e-04 yes")
    assert front.plateaus(MEASURED)[1] == "  Tsit5, width 1e-02: 2e-03 (10 ms)"
    falling = [row("smoothed", "Tsit5, width 1e-02", error, 1e-3) for error in (1e-2, 1e-3)]
    assert "not there yet" in front.plateaus(falling)[1]


def test_a_picture_is_drawn_of_what_was_measured(tmp_path):
    picture.draw(PROBLEMS["sd"], MEASURED, tmp_path / "sd.png")
    assert (tmp_path / "sd.png").stat().st_size > 10_000


def test_a_measured_row_says_what_was_run():
    measured = rows(PROBLEMS["impact"], single(scipy_events, "impact", "RK45"), quick=True)
    assert [r.setting for r in measured] == [1e-4, 1e-8]
    assert measured[0].contacts == 7 and measured[1].error < 1e-6 < measured[0].error
    assert all(r.seconds > 0 and r.compiling >= 0 and r.steps > 7 for r in measured)
