"""Problems of the event-driven and Filippov literature with known answers (`tests.problems`).

The default stepper throughout.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from tests.problems import PROBLEMS, closed_forms, tagged
from tests.problems.values import (
    DEN_HARTOG_AMPLITUDE,
    DEN_HARTOG_STICKS,
    SLIP_STICK_PERIOD,
    WALL_GRAZES,
)
from tests.results import assert_solves, by_imaginary_part, run, solved, table

CROSS, STICK = EventKind.crossing, EventKind.stick


@pytest.mark.slow
@pytest.mark.parametrize("name", [*tagged("textbook", but="sd"), "den hartog"])
def test_a_problem_has_its_known_motion(name):
    assert_solves(PROBLEMS[name], solved(PROBLEMS[name]))


def test_coulomb_oscillator_is_saved_and_printed():
    p = PROBLEMS["coulomb"]
    # A little after each turn, when it has stuck, and long after.
    turns = np.pi * np.arange(1.0, 5.0) + 1e-3
    sol = run(p.system, p.x0, p.t1, p.dt, ts=[*turns[:2], p.t1])
    assert_solves(p, sol)
    rows = repr(sol.events).splitlines()
    assert rows[0].split() == ["t", "kind", "surface", "x", "just", "before"]
    assert rows[4].split()[:4] == ["12.5663706143592", "stick", "0", "[-0.2,"] and len(rows) == 5
    assert "3 states saved (room for 3)" in repr(sol)
    assert_allclose(sol.xs[-1], p.end, rtol=0, atol=1e-12)
    assert_array_equal(sol.modes[:, 0], [1, -1, 0])
    later = run(p.system, p.x0, p.t1, p.dt, ts=[*turns[2:], p.t1])
    assert_array_equal(later.modes[:, 0], [1, 0, 0])


def test_coulomb_oscillator_derivatives():
    # Exact: ∂x(20)/∂(x0, v0, F) = (1, 0, -8); the velocity is 0 whatever they are.
    def end(x0, friction):
        system = jf.systems.CoulombOscillator(friction=friction)
        return jf.solve(system, x0, 0.0, 20.0, 0.1).xs[-1]

    d_x0, d_friction = jax.jacfwd(end, (0, 1))(jnp.asarray([3.0, 0.0]), jnp.asarray(0.4))
    assert_allclose(d_x0, [[1, 0], [0, 0]], rtol=0, atol=1e-12)
    assert_allclose(d_friction, [-8, 0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("end", [0.5, 1.7, 2.0])
def test_rotating_oscillator(end):
    # Exact: switches at t = 1, ends at e^(T-1) at angle -2π(T-1).
    p = PROBLEMS["rotating"]
    sol = run(p.system, p.x0, end, p.dt)
    times, _ = table(sol)
    assert_allclose(times, [1.0] if end > 1 else [], rtol=1e-12)
    angle = 2 * np.pi * (end - 1) * (1 if end > 1 else -1)
    want = np.exp(end - 1) * np.asarray([np.cos(angle), -np.sin(angle)])
    assert_allclose(sol.xs[-1], want, rtol=0, atol=1e-11)


def test_rotating_oscillator_between_its_steps():
    # The dense output keeps the order, across the contact at t = 1 too.
    saveat = diffrax.SaveAt(dense=True)
    x0 = jnp.asarray([np.exp(-1), 0.0])
    sol = jf.solve(jf.systems.RotatingOscillator(), x0, 0.0, 2.0, 0.02, saveat=saveat)
    ts = np.asarray([0.0, 0.333, 0.9999, 1.0001, 1.011, 1.777, 2.0])
    angle = 2 * np.pi * abs(ts - 1)
    want = np.exp(ts - 1)[:, None] * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    assert_allclose(jax.vmap(sol.evaluate)(jnp.asarray(ts)), want, rtol=0, atol=1e-11)
    assert np.isnan(sol.evaluate(2.1)).all()


def test_smoothed_field_by_hand():
    # sgn x' becomes (2/π) arctan(x'/width).
    smooth = jf.smoothed(jf.systems.CoulombOscillator(friction=0.4), 0.1)
    field = smooth.vector_field(jnp.zeros(()), jnp.asarray([0.5, 0.2]), jnp.zeros((0,)))
    assert_allclose(field, [0.2, -0.5 - 0.4 * 2 / np.pi * np.arctan(2)], rtol=1e-14)


@pytest.mark.slow
def test_smoothed_coulomb_oscillator_comes_close():
    smooth = jf.smoothed(jf.systems.CoulombOscillator(friction=0.4), 1e-3)
    sol = jf.solve(smooth, jnp.asarray([3.0, 0.0]), 0.0, 4 * np.pi, 1e-4)
    assert sol.num_events == 0
    # Where it should stick it creeps, at the speed width·tan(π/2 · 0.2/0.4).
    assert_allclose(sol.xs[-1], [-0.2, 1e-3], rtol=0, atol=1e-2)


@pytest.mark.slow
def test_slip_stick_multipliers():
    # Autonomous: 1 along the orbit; an orbit that sticks: 0 across it.
    def end(x0, t1):
        return jf.solve(jf.systems.SlipStick(), x0, 0.0, t1, 0.02).xs[-1]

    x0 = end(jnp.asarray([1.0, 0.2]), 2.0)
    multipliers = np.linalg.eigvals(jax.jacfwd(end)(x0, SLIP_STICK_PERIOD))
    assert_allclose(sorted(abs(multipliers)), [0, 1], rtol=0, atol=1e-11)
    assert abs(np.linalg.det(jax.jacfwd(end)(x0, SLIP_STICK_PERIOD))) < 1e-12


def test_den_hartog_multipliers():
    p = PROBLEMS["den hartog"]

    def end(x0):
        return jf.solve(p.system, x0, p.t0, p.t0 + p.system.period, p.dt).xs[-1]

    amplitude, _ = closed_forms.den_hartog()
    assert_allclose(amplitude, DEN_HARTOG_AMPLITUDE, rtol=0, atol=1e-10)
    multipliers = by_imaginary_part(np.linalg.eigvals(jax.jacfwd(end)(jnp.asarray(p.x0))))
    want = 0.022940452694 + 0.696700298863j
    assert_allclose(multipliers, [want.conjugate(), want], rtol=0, atol=1e-11)
    assert_allclose(multipliers, p.multipliers, rtol=0, atol=p.digits)


def test_den_hartog_sticks_beyond_its_crossing_sliding():
    # Where ρ = 0: transients die at once.
    omega = 0.8
    s_star = closed_forms.den_hartog_sticks(omega)
    assert_allclose(s_star, DEN_HARTOG_STICKS, rtol=0, atol=1e-10)
    period = 2 * np.pi / omega

    def slides(s):
        system = jf.systems.DenHartog(friction=s, omega=omega)
        x0 = jnp.asarray([0.5, 0.5])
        start = jf.solve(system, x0, 0.0, 60 * period, 0.1, max_events=None).xs[-1]
        sol = jf.solve(system, start, 0.0, 4 * period, 0.1, max_events=16)
        return jnp.sum(sol.events.kinds == STICK), jnp.sum(sol.events.kinds == CROSS)

    sticks, crossings = jax.jit(jax.vmap(slides))(s_star + jnp.asarray([-1e-5, 1e-5]))
    assert_array_equal(sticks, [0, 8])
    assert_array_equal(crossings, [8, 0])


@pytest.mark.slow
@pytest.mark.parametrize(("omega", "amplitude"), [(1.0, 0.1), (1.2, WALL_GRAZES)])
def test_impact_oscillator(omega, amplitude):
    # Exact grazing amplitude √((k - ω²)² + c²ω²) d. On the steady orbit just below it the wall is
    # not reached; just above it is, in the first period.
    exact = closed_forms.wall_amplitude(omega)
    assert_allclose(exact, amplitude, rtol=0, atol=1e-10)

    # x = A cos(ωt - δ)/exact on the steady orbit.
    delta = np.arctan2(0.1 * omega, 1 - omega**2)
    unit = jnp.asarray([np.cos(delta), omega * np.sin(delta)])

    def impacts(scale):
        system = jf.systems.ImpactOscillator(amplitude=exact * scale, omega=omega)
        sol = jf.solve(system, scale * unit, 0.0, system.period, 0.05)
        return sol.num_events, sol.events.kinds[0], sol.xs[-1] - scale * unit

    scales = 1 + jnp.asarray([-1e-3, -1e-9, 1e-9, 1e-3])
    counts, kinds, gaps = jax.jit(jax.vmap(impacts))(scales)
    assert_array_equal(counts[:2], 0)
    assert np.all(np.asarray(counts[2:]) >= 1)
    assert_array_equal(kinds[2:], EventKind.impact)
    assert_allclose(gaps[:2], 0, rtol=0, atol=1e-11)


def test_bouncing_ball_for_ever():
    # Exact: 10/7, 4, 6.3142857..., accumulating at 190/7 = 27.142857...
    p = PROBLEMS["bouncing ball"]
    x0 = jnp.asarray(p.x0, float)
    sol = jf.solve(p.system, x0, 0.0, 40.0, 0.25, throw=False)
    times, kinds = table(sol)
    assert sol.result == RESULTS.successful
    assert set(kinds[:-1]) == {EventKind.impact} and kinds[-1] == EventKind.stick
    assert_allclose(times[:3], [10 / 7, 4, 6.3142857142857143], rtol=1e-13)
    assert_allclose(times[:100], closed_forms.bounces(0.9, 100), rtol=1e-11)
    assert_allclose(times[-1], 190 / 7, rtol=1e-12)
    assert_allclose(sol.x_final, 0, rtol=0, atol=1e-14)


def test_filippov_spiral_rests_at_the_origin():
    p = PROBLEMS["filippov spiral"]
    sol = run(p.system, p.x0, p.t1, p.dt, ts=[1 / 6, 0.50001, 2.0])
    assert_solves(p, sol)
    times, kinds = table(sol)
    assert_allclose(times[:8], p.ts, rtol=1e-12)
    assert_allclose(times[-1], 0.5, rtol=1e-12)
    assert kinds[-1] == STICK
    assert_allclose(sol.xs, [[1 / 6, 0.5], [0, 0], [0, 0]], rtol=0, atol=1e-13)
    assert_array_equal(sol.modes[1:], 0)


def test_tables_without_contacts_and_of_many_lanes_are_printed_too():
    def events(x):
        return jf.solve(jf.systems.TwoRelays(), x, 0.0, 0.1, 0.1, max_events=4).events

    assert repr(events(jnp.asarray([1.5, 1.0]))) == "Events: no contacts"
    assert repr(jax.vmap(events)(jnp.ones((3, 2)) * 1.5)) == "Events: tables of shape (3, 4)"
