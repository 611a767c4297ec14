"""The choice of a step: its error is that against closed forms, and other verbs take it."""

import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from tests.problems import PROBLEMS, closed_forms

TOLERANCE = 1e-7


@pytest.fixture(scope="module")
def rotating():
    """The spiral, from three radii inside of the surface that it crosses."""
    p = PROBLEMS["rotating"]
    states = np.asarray(p.x0) * np.array([[1.0], [1.2], [0.9]])
    choice = jf.choose_step(
        p.system, states, 0.0, 2.3, tolerance=TOLERANCE, steppers=[jf.RK4(), jf.Rodas5P()]
    )
    return p.system, jnp.asarray(states), choice


def errors(system, states, dt, **options):
    """Of each lane, against the closed form."""
    for x0 in states:
        exact = np.asarray(closed_forms.rotating(system, x0, 0.0, 2.3))
        end = np.asarray(jf.solve(system, x0, 0.0, 2.3, dt, **options).x_final)
        yield max(abs(end - exact)) / max(abs(exact))


@pytest.mark.release
def test_the_error_of_every_lane_is_below_the_tolerance_and_not_far(rotating):
    system, states, choice = rotating
    true = max(errors(system, states, choice))
    assert TOLERANCE / 3 < true <= TOLERANCE
    assert true == pytest.approx(choice.error, rel=0.01)
    assert choice.reference_error < TOLERANCE / 100
    assert choice.dt == pytest.approx(2.3 / choice.steps)


@pytest.mark.slow
def test_the_table_is_what_was_measured_and_the_choice_the_cheapest_of_it(rotating):
    system, states, choice = rotating
    assert choice.steppers == ("RK4", "Rodas5P")
    enough = []
    for i in range(2):
        real = choice.counts[i] > 0
        assert np.all(np.diff(choice.counts[i][real]) > 0) and np.all(choice.times[i][real] > 0)
        good = choice.errors[i][real] <= TOLERANCE
        k = int(np.flatnonzero(~good).max()) + 1
        assert good[k:].all()
        enough.append((choice.times[i, k], choice.counts[i, k]))
    assert (choice.seconds, choice.steps) == min(enough)
    k = int(np.flatnonzero(choice.counts[0] == 32)[0])
    true = max(errors(system, states, 2.3 / 32, stepper=jf.RK4()))
    assert choice.errors[0, k] == pytest.approx(true, rel=1e-3)


def test_the_card_and_the_picture_say_what_was_chosen(rotating):
    _, _, choice = rotating
    told = repr(choice).splitlines()
    name = type(choice.stepper).__name__
    assert told[0].startswith(f"StepChoice: {name}, {choice.steps} steps in all (dt = ")
    assert told[0].endswith("successful")
    assert told[1].startswith(f"  error {choice.error:.1e} of a tolerance of 1e-07")
    assert [line.split()[0] for line in told[2:]] == ["RK4", "Rodas5P"]
    ax = choice.plot(matplotlib.figure.Figure().add_subplot())
    *_, ring = ax.lines
    np.testing.assert_allclose(ring.get_xydata(), [[choice.seconds, choice.error]])


@pytest.mark.slow
def test_a_choice_for_a_sweep_is_taken_as_its_steps():
    wall = jf.systems.ImpactOscillator(amplitude=0.05)
    omegas = jnp.array([0.8, 1.2])
    x0 = jnp.array([0.2, 0.1])
    choice = jf.choose_step(
        wall,
        x0,
        0.0,
        20.0,
        tolerance=1e-5,
        steppers=[jf.RK4()],
        parameter="omega",
        values=omegas,
    )
    assert choice.forced and len(choice.reference) == 2
    assert choice.dt == pytest.approx(2 * np.pi / choice.steps)
    given = {"transient": 2, "samples": 2, "progress": False}
    swept = jf.bifurcation_diagram(wall, "omega", omegas, x0, steps=choice, **given)
    same = jf.bifurcation_diagram(
        wall, "omega", omegas, x0, steps=choice.steps, stepper=jf.RK4(), **given
    )
    np.testing.assert_array_equal(swept.xs, same.xs)
    assert swept.conditions.stepper == "RK4" and swept.conditions.steps == choice.steps
    with pytest.raises(ValueError, match="`stepper` must be None with a StepChoice"):
        jf.solve(wall, x0, 0.0, 1.0, choice, stepper=jf.RK4())
    spiral = jf.systems.RotatingOscillator()
    message = (
        "`steps` must be a number, since a StepChoice for a forced .* RotatingOscillator has no"
    )
    with pytest.raises(ValueError, match=message):
        jf.periodic_orbit(spiral, x0, period=6.0, steps=choice)


@pytest.mark.slow
def test_what_no_step_meets_is_told():
    system, x0 = jf.systems.RotatingOscillator(), jnp.array([0.4, 0.0])
    given = {"tolerance": 1e-18, "steppers": [jf.RK4()]}
    choice = jf.choose_step(system, x0, 0.0, 0.5, throw=False, **given)
    assert outcome_names(choice.result) == "tolerance_not_met"
    assert choice.error == np.nanmin(choice.errors)
    assert "does not meet the tolerance with up to" in repr(choice)
    with pytest.raises(RuntimeError, match="No number of steps that was tried"):
        jf.choose_step(system, x0, 0.0, 0.5, **given)
    # At the origin both sides of the arch lead away.
    lost = jf.choose_step(
        jf.systems.SDOscillator(), jnp.zeros(2), 0.0, 1.0, steppers=[jf.RK4()], throw=False
    )
    assert outcome_names(lost.result) == "nonunique"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tolerance": 0.0}, "`tolerance` must be a positive number"),
        ({"steppers": []}, "`steppers` must be a list of steppers"),
        ({"steppers": [None]}, r"`steppers\[0\]` must be jaxfil"),
        ({"parameter": "omega"}, "`values` must be given together with `parameter`"),
        ({"parameter": "omega", "values": np.ones((2, 2))}, r"`values` must be of shape \(p,\)"),
        ({"t1": 0.0}, "`t1` must differ from `t0`"),
    ],
)
def test_bad_calls_name_the_argument(change, message):
    call = {"t0": 0.0, "t1": 1.0} | change
    with pytest.raises(ValueError, match=message):
        jf.choose_step(jf.systems.RotatingOscillator(), jnp.array([0.4, 0.0]), **call)


class Pulsed(jf.System):
    """x' = a pulse of area 1 at t = 0.640625, of the given width."""

    width: float = 2e-3

    def vector_field(self, t, x, side):
        late = (t - 0.640625) / self.width
        return jnp.exp(-(late**2))[None] / (self.width * np.pi**0.5)

    def switching(self, t, x):
        return jnp.ones_like(t)


@pytest.mark.slow
def test_a_stepper_whose_steps_miss_a_pulse_is_not_the_reference():
    # RK4 evaluates the field first at multiples of 1/8, 1/16 and 1/32, where the pulse is zero, so
    # that its ends do not change.
    x0 = jnp.array([1.0])
    choice = jf.choose_step(Pulsed(), x0, 0.0, 1.0, tolerance=1e-6)
    assert choice.result == jf.RESULTS.successful
    end = jf.solve(Pulsed(), x0, 0.0, 1.0, choice).x_final[0]
    assert abs(end - 2) < 2 * 2e-6
