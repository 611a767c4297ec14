"""Error against run time: errors are those against closed forms, the table says what it knows."""

import time
from types import SimpleNamespace

import diffrax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil.__main__ import main
from tests.oracles.compilations import Counter
from tests.problems import PROBLEMS, closed_forms

DTS = [0.1, 0.05, 0.025]


@pytest.fixture(scope="module")
def compilations():
    """How much JAX had traced and compiled at each look at the clock, before and after a run."""
    return []


@pytest.fixture(scope="module")
def rotating(compilations):
    p = PROBLEMS["rotating"]
    x0 = jnp.asarray(p.x0)
    steppers = [jf.RK4(), diffrax.Dopri8()]
    exact = np.asarray(closed_forms.rotating(p.system, x0, 0.0, 2.3))
    counter = Counter()
    counter.watch()

    def clock():
        compilations.append(counter.counts["traces"] + counter.counts["compilations"])
        return time.perf_counter()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxfil.studies.timing.time", SimpleNamespace(perf_counter=clock))
        return jf.work_precision(p.system, x0, 2.3, steppers, DTS, lanes=3), exact


@pytest.mark.slow
def test_errors_are_those_against_the_closed_form(rotating):
    table, exact = rotating
    assert table.steppers == ("RK4", "Dopri8")
    assert_allclose(table.reference, exact, rtol=0, atol=2e-13)
    for i, stepper in enumerate((jf.RK4(), diffrax.Dopri8())):
        p = PROBLEMS["rotating"]
        for k, dt in enumerate(DTS):
            end = jf.solve(p.system, jnp.asarray(p.x0), 0.0, 2.3, dt, stepper=stepper).xs[-1]
            assert_allclose(table.errors[i, k], abs(end - exact).max(), rtol=0, atol=4e-13)
    assert np.all(table.num_events == 1) and table.reference_events == 1


def test_the_reference_knows_how_good_it_is(rotating):
    table, exact = rotating
    true = abs(table.reference - exact).max()
    assert table.reference_stepper == "Dopri8"
    assert table.reference_error < 1e-12 and true < 2e-13
    # RK4 at dt = 1/160 is the other opinion: 1/16 of its error there of that at 1/80.
    assert 1e-8 < table.reference_check < table.errors[0, 2]


def test_run_times_leave_compiling_out(rotating, compilations):
    table, _ = rotating
    assert np.all(table.seconds > 0)
    before, after = np.reshape(compilations, (-1, 2)).T
    assert len(before) == 5 * table.seconds.size, "the median of five runs of each"
    assert_array_equal(before, after)
    assert before.max() > before.min(), "the second stepper is compiled after runs of the first"


def test_the_recommendation_is_the_fastest_run_that_is_good_enough(rotating):
    table, _ = rotating
    assert str(table).splitlines()[-1] == table.recommendation()
    for tolerance in (1e-3, 1e-5, 1e-9):
        good = table.errors <= tolerance * abs(table.reference).max()
        assert good.any()
        i, k = np.argwhere(table.seconds == table.seconds[good].min())[0]
        line = table.recommendation(tolerance)
        assert line.startswith(f"{table.steppers[i]}, dt = {DTS[k]:g}: {table.errors[i, k]:.1e} at")
    i, k = np.unravel_index(table.errors.argmin(), table.errors.shape)
    best = table.recommendation(1e-30)
    assert best.startswith(f"{table.steppers[i]}, dt = {DTS[k]:g}") and "best here" in best


def test_the_table_has_a_line_for_every_run(rotating):
    table, _ = rotating
    lines = str(table).splitlines()
    assert len(lines) == 1 + 2 * 3 + 2
    assert lines[1].split()[:3] == ["RK4", "0.1", f"{table.errors[0, 0]:.1e}"]
    assert lines[-2].startswith("Reference: Dopri8, dt = 0.00625, 1 contacts; halving")


def test_the_picture_has_a_line_for_every_stepper(rotating):
    table, _ = rotating
    ax = table.plot(matplotlib.figure.Figure().add_subplot())
    rk4, dopri8, floor = ax.lines
    assert_allclose(rk4.get_xydata().T, [table.seconds[0], table.errors[0]])
    assert np.all(dopri8.get_ydata() >= floor.get_ydata()[0])
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["RK4", "Dopri8", "reference"]


def test_a_run_that_does_not_reach_the_end_has_no_error():
    # At the origin its two sides both lead away.
    system, x0 = jf.systems.SDOscillator(), jnp.zeros(2)
    table = jf.work_precision(system, x0, 1.0, [jf.RK4()], [0.1], repeats=1)
    assert np.all(np.isnan(table.errors)) and table.outcomes.tolist() == [["nonunique"]]
    assert str(table).splitlines()[-1] == "No run reached t1."


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dts": []}, "`dts` must be positive step lengths"),
        ({"dts": [0.1, -0.1]}, "`dts` must be positive step lengths"),
        ({"steppers": []}, "`steppers` must be a list of steppers"),
        ({"steppers": jf.RK4()}, "`steppers` must be a list of steppers"),
        ({"steppers": ["RK4"]}, r"`steppers\[0\]` must be"),
        ({"steppers": [None]}, r"`steppers\[0\]` must be"),
        ({"repeats": 0}, "`repeats` must be an integer of at least 1"),
        ({"lanes": 0}, "`lanes` must be an integer of at least 1"),
        ({"t1": "later"}, "`t1` must be a number"),
    ],
)
def test_bad_calls_name_the_argument(change, message):
    call = {"t1": 1.0, "steppers": [jf.RK4()], "dts": [0.1]} | change
    with pytest.raises(ValueError, match=message):
        jf.work_precision(jf.systems.CoulombOscillator(), jnp.asarray([3.0, 0.0]), **call)


@pytest.mark.slow
def test_the_command_prints_the_table_and_draws_it(capsys, tmp_path):
    out = tmp_path / "coulomb.png"
    words = "work-precision coulomb-oscillator --set friction=0.3 --time 2 --steps 10 20"
    code = main([*words.split(), "--steppers", "RK4", "--out", str(out)])
    lines = capsys.readouterr().out.splitlines()
    assert code == 0 and out.stat().st_size > 10_000
    assert [line.split()[:2] for line in lines[1:3]] == [["RK4", "0.1"], ["RK4", "0.05"]]
    # x = 0.3 + 2.7... until it turns at π: RK4's error at 20 steps a unit of time.
    sol = jf.solve(
        jf.systems.CoulombOscillator(friction=0.3),
        jnp.asarray([3.0, 0.0]),
        0.0,
        2.0,
        0.05,
        stepper=jf.RK4(),
    )
    exact = np.asarray([0.3 + 2.7 * np.cos(2), -2.7 * np.sin(2)])
    assert_allclose(float(lines[2].split()[2]), abs(sol.xs[-1] - exact).max(), rtol=0.05)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nothing", "NAME must be one of"),
        ("coulomb-oscillator --set mu=1", "--set must be one of friction"),
        ("coulomb-oscillator --time -1", "--time: must be positive"),
        ("coulomb-oscillator --x0 1,2,3", "--x0 must be 2 numbers"),
        ("coulomb-oscillator --steppers Euler9", "invalid choice"),
    ],
)
def test_a_command_that_cannot_be_carried_out_gets_one_line(capsys, words, message):
    assert main(["work-precision", *words.split()]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and message in err
