"""Slides that have broken trusted codes: one test a case, against answers by hand."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind


class Corner(jf.System):
    """A constant field in each of the four quadrants of two lines."""

    table: jax.Array
    n: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        rows = jnp.where(side[0] > 0, self.table[0], self.table[1])
        return jnp.where(side[1] > 0, rows[0], rows[1])

    def switching(self, t, x):
        return self.n @ x - self.c


def corner(field, n=((1, 0), (0, 1)), c=(0, 0)):
    """A `Corner` scene from a function of the two sides, by default with the axes as surfaces."""
    table = [[field(s1, s2) for s2 in (1, -1)] for s1 in (1, -1)]
    return Corner(*(jnp.asarray(v, float) for v in (table, n, c)))


def run(system, x0, t1, dt, ts=None):
    """Three saved times and a table of events, so that all lanes share one compiled program."""
    ts = jnp.linspace(0.0, t1, 3) if ts is None else jnp.asarray(ts, float)
    x0 = jnp.asarray(x0, float)
    saveat = diffrax.SaveAt(ts=ts)
    return jf.solve(system, x0, 0.0, t1, dt, saveat=saveat, max_events=64, throw=False)


def table(sol):
    """Times and kinds of the events that happened."""
    count = int(sol.num_events)
    assert np.all(np.isinf(sol.events.ts[count:]))
    assert np.all(sol.events.kinds[count:] == EventKind.none)
    return np.asarray(sol.events.ts[:count]), sol.events.kinds[:count].tolist()


# Belt friction case 1, exact per piece with 40-digit roots (mpmath): x(0) on the orbit, then the
# modes and times of its switches in one period.
SLIPS = {
    1.4: (
        1.5670473725058692029,
        [0.021115703825789773, 2.61911511215335305, 2.74881294392022106, 2.9398327291587959],
        [-1, 0, -1, 0],
    ),
    1.54892: (
        0.62813535977215724309,
        [0.581512870137695392, 2.26965284989511371, 3.5971186797855341, 3.61587613681139833],
        [-1, 0, 1, 0],
    ),
}


@pytest.mark.parametrize("omega", SLIPS)
@pytest.mark.parametrize("steps", [25, 60])
def test_slip_shorter_than_a_step_inside_a_stick(omega, steps):
    # The second slip at omega = 1.54892 lasts 0.0188; a step is 0.16 or 0.068.
    x1, times, modes = SLIPS[omega]
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=omega)
    period = 2 * np.pi / omega
    sol = run(belt, (x1, 1), period, period / steps)
    ts, kinds = table(sol)
    assert kinds == [EventKind.stick if m == 0 else EventKind.slip for m in modes]
    assert_allclose(ts, times, atol=1e-10 if steps == 60 else 1e-5)
    assert_allclose(sol.xs[-1], [x1, 1], atol=1e-10 if steps == 60 else 1e-5)


def sticks_and_slips(belts, x0, periods, per_period):
    """Number of sticks and slips per lane, after checking that they alternate."""

    def lane(belt):
        dt = belt.period / 40
        size = per_period * periods
        sol = jf.solve(belt, x0, 0.0, periods * belt.period, dt, max_events=size, throw=False)
        return sol.result == RESULTS.successful, sol.events.kinds

    good, kinds = jax.jit(jax.vmap(lane))(belts)
    assert good.all()
    for row in np.asarray(kinds):
        order = row[(row == EventKind.stick) | (row == EventKind.slip)]
        assert np.all(order[1:] != order[:-1])
    return (kinds == EventKind.stick).sum(axis=1), (kinds == EventKind.slip).sum(axis=1)


def test_leaving_a_stick_in_the_linear_case():
    # 1e5 periods, one stick and one slip in each (physics: only 0 -> -1 -> 0 for these omega).
    belts = jax.vmap(lambda w: jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=w))(
        jnp.linspace(1.25, 1.35, 100)
    )
    sticks, slips = sticks_and_slips(belts, jnp.asarray([1.56, 1.0]), 1000, 3)
    assert np.all(np.abs(np.asarray(slips) - 1000) <= 1)
    assert np.all(np.abs(sticks - slips) <= 1)


def test_leaving_a_stick_in_the_cubic_case():
    belts = jax.vmap(lambda w: jf.systems.BeltFriction(omega=w))(jnp.linspace(4.655, 4.7, 100))
    sticks, slips = sticks_and_slips(belts, jnp.asarray([0.1, 1.0]), 1000, 12)
    assert np.all(sticks > 500)
    assert np.all(np.abs(sticks - slips) <= 1)


@pytest.mark.parametrize("dt", [0.01, 0.3, 7.0])
def test_held_surface(dt):
    # Through y = 1/2 without a change of speed, then held at y = 1 for ever.
    system = corner(lambda s1, s2: (s1, -s2), n=((0, 1), (0, 1)), c=(0.5, 1))
    sol = run(system, (0, 0), 100.0, dt)
    ts, kinds = table(sol)
    assert_allclose(ts, [0.5, 1.0], rtol=1e-13)
    assert kinds == [EventKind.crossing, EventKind.stick]
    assert_allclose(sol.xs[-1], [99, 1], rtol=1e-13)


RELAY = jf.piecewise(
    lambda t, x: jnp.asarray([1.0, -1.0]), lambda t, x: jnp.ones(2), lambda t, x: x[1]
)


@pytest.mark.parametrize("dt", [0.01, 0.3, 1.0, 5.0])
@pytest.mark.parametrize("start", [1, -1])
def test_chattering(dt, start):
    sol = run(RELAY, (0, start), 5.0, dt, ts=[1.5, 3.0, 5.0])
    ts, kinds = table(sol)
    assert kinds == [EventKind.stick]
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert_array_equal(sol.xs[:, 1], 0)
    assert_array_equal(sol.modes[:, 0], 0)


@pytest.mark.parametrize("dt", [0.01, 0.5, 10.0])
def test_zeno(dt):
    # t1 = 10/7, t∞ = t1 (1 + e)/(1 - e) = 30/7.
    ball = jf.systems.BouncingBall(g=9.8, restitution=0.5)
    sol = run(ball, (10, 0), 20.0, dt)
    assert sol.result == RESULTS.zeno
    assert_allclose(sol.t_final, 30 / 7, rtol=1e-10)
    assert_allclose(sol.x_final, [0, 0], atol=1e-9)
    assert np.all(np.isinf(sol.xs[1:]))
    ts, kinds = table(sol)
    assert_allclose(ts[:5], 10 / 7 * (3 - 2 * 0.5 ** np.arange(5)), rtol=1e-12)
    assert set(kinds) == {EventKind.impact}


@pytest.mark.parametrize("dt", [0.01, 0.1, 1.0])
def test_zeno_ends_in_a_slide_on_both_surfaces(dt):
    # Filippov's spiral reaches the origin at t = 1/2 and rests there.
    spiral = corner(lambda s1, s2: (-s1 + 2 * s2, -2 * s1 - s2))
    sol = run(spiral, (0, 1), 1.0, dt, ts=[0.1, 0.6, 1.0])
    assert sol.result == RESULTS.successful
    assert_allclose(sol.xs[1:], 0, atol=1e-14)
    assert_array_equal(sol.modes[1:], 0)
    ts, _ = table(sol)
    assert_allclose(ts[-1], 0.5, rtol=1e-12)
    assert_allclose(ts[:3], [1 / 3, 4 / 9, 13 / 27], rtol=1e-12)


def test_stick_slip_chains_of_the_coulomb_oscillator():
    # Exact: turns at π, 2π, 3π, sticks at 4π with x = 3 - 8 F.
    sol = run(jf.systems.CoulombOscillator(friction=0.4), (3, 0), 20.0, 0.05)
    ts, kinds = table(sol)
    assert kinds == [EventKind.crossing] * 3 + [EventKind.stick]
    assert_allclose(ts, np.pi * np.arange(1, 5), rtol=1e-12)
    assert_allclose(sol.xs[-1], [-0.2, 0], atol=1e-12)


def test_stick_slip_chains_where_one_stick_releases_another():
    # y1' = -s1, y2' = -s2 + 1.5 + s1: when y1 sticks (s1 = 0), y2 can no longer be held.
    system = corner(lambda s1, s2: (-s1, -s2 + 1.5 + s1))
    sol = run(system, (-1, 0), 2.0, 0.3, ts=[0.5, 1.0, 2.0])
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.modes, [[-1, 0], [0, 1], [0, 1]])
    assert_allclose(sol.xs[-1], [0, 0.5], atol=1e-14)


def test_leaving_a_slide_at_a_fold():
    # Exact: the circle is met at ln(2/1.01)/2; with φ the angle from (1, -1), φ' = -cot(φ/2)
    # along it, until (-1, -1) where φ = 3π/2.
    meet = 0.5 * np.log(2 / 1.01)
    exit_ = meet - np.log(2) - 2 * np.log(-np.cos(5 * np.pi / 8 - np.arctan(0.1) / 2))
    assert_allclose(exit_, 1.82862978083, rtol=1e-11)

    def error(steps):
        fold = jf.systems.VisibleFold()
        sol = jf.solve(fold, jnp.asarray([-1.0, 0.1]), 0.0, 3.0, 3.0 / steps, max_events=4)
        _, kinds = table(sol)
        assert kinds == [EventKind.stick, EventKind.slip]
        assert_allclose(sol.events.xs[1], [-1, -1], rtol=1e-12)
        return abs(float(sol.events.ts[1]) - exit_)

    steps = np.array([10, 12, 15, 18, 20, 22, 25, 27])
    order = -np.polyfit(np.log(steps), np.log([error(s) for s in steps]), 1)[0]
    assert abs(order - 8) < 0.5
