"""Slides that have broken trusted codes: one test a case, against answers by hand."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.model.outcomes import outcome_names
from tests.problems import PROBLEMS, tagged
from tests.problems.systems import corner
from tests.results import assert_solves, run, solved, table


@pytest.mark.slow
@pytest.mark.parametrize("name", tagged("hand sliding"))
def test_a_problem_has_its_known_motion(name):
    assert_solves(PROBLEMS[name], solved(PROBLEMS[name]))


@pytest.mark.parametrize("name", ["belt 1.4", "belt 1.54892"])
@pytest.mark.parametrize("steps", [25, 60])
def test_slip_shorter_than_a_step_inside_a_stick(name, steps):
    # The second slip at omega = 1.54892 lasts 0.0188; a step is 0.16 or 0.068.
    p = PROBLEMS[name]
    sol = run(p.system, p.x0, p.t1, p.t1 / steps)
    ts, kinds = table(sol)
    assert kinds == p.kinds == [EventKind.slip, EventKind.stick] * 2
    assert_allclose(ts, p.ts, rtol=0, atol=1e-10 if steps == 60 else 1e-5)
    assert_allclose(sol.xs[-1], p.end, rtol=0, atol=1e-10 if steps == 60 else 1e-5)


def sticks_and_slips(belts, x0, periods, per_period):
    """Number of sticks and slips per lane, after checking that they alternate."""

    def lane(belt):
        dt = belt.period / 40
        size = per_period * periods
        options = {"stepper": diffrax.Tsit5(), "max_events": size, "throw": False}
        sol = jf.solve(belt, x0, 0.0, periods * belt.period, dt, **options)
        return sol.result == RESULTS.successful, sol.events.kinds

    good, kinds = jax.jit(jax.vmap(lane))(belts)
    assert good.all()
    for row in np.asarray(kinds):
        order = row[(row == EventKind.stick) | (row == EventKind.slip)]
        assert np.all(order[1:] != order[:-1])
    return (kinds == EventKind.stick).sum(axis=1), (kinds == EventKind.slip).sum(axis=1)


@pytest.mark.slow
def test_leaving_a_stick_in_the_linear_case():
    # 1e5 periods, one stick and one slip in each (physics: only 0 -> -1 -> 0 for these omega).
    belts = jax.vmap(lambda w: jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=w))(
        jnp.linspace(1.25, 1.35, 100)
    )
    sticks, slips = sticks_and_slips(belts, jnp.asarray([1.56, 1.0]), 1000, 3)
    assert np.all(np.abs(np.asarray(slips) - 1000) <= 1)
    assert np.all(np.abs(sticks - slips) <= 1)


@pytest.mark.slow
def test_leaving_a_stick_in_the_cubic_case():
    belts = jax.vmap(lambda w: jf.systems.BeltFriction(omega=w))(jnp.linspace(4.655, 4.7, 100))
    sticks, slips = sticks_and_slips(belts, jnp.asarray([0.1, 1.0]), 1000, 12)
    assert np.all(sticks > 500)
    assert np.all(np.abs(sticks - slips) <= 1)


@pytest.mark.parametrize("dt", [0.01, 0.3, 7.0])
def test_held_surface(dt):
    p = PROBLEMS["held surface"]
    sol = run(p.system, p.x0, 100.0, dt)
    ts, kinds = table(sol)
    assert_allclose(ts, p.ts, rtol=1e-13)
    assert kinds == p.kinds
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
def test_infinitely_many_impacts_end_in_rest(dt):
    # t1 = 10/7, t∞ = t1 (1 + e)/(1 - e) = 30/7.
    p = PROBLEMS["ball that comes to rest"]
    sol = run(p.system, p.x0, p.t1, dt)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.x_final, p.end, rtol=0, atol=1e-14)
    ts, kinds = table(sol)
    assert_allclose(ts[:5], p.ts, rtol=1e-12)
    assert_allclose(p.ts, 10 / 7 * (3 - 2 * 0.5 ** np.arange(5)), rtol=1e-14)
    assert_allclose(ts[-1], 30 / 7, rtol=1e-12)
    assert set(kinds[:-1]) == {EventKind.impact} and kinds[-1] == EventKind.stick


@pytest.mark.parametrize("dt", [0.01, 0.1, 1.0])
def test_zeno_ends_in_a_slide_on_both_surfaces(dt):
    # Filippov's spiral reaches the origin at t = 1/2 and rests there.
    spiral = corner(lambda s1, s2: (-s1 + 2 * s2, -2 * s1 - s2))
    sol = run(spiral, (0, 1), 1.0, dt, ts=[0.1, 0.6, 1.0])
    assert sol.result == RESULTS.successful
    assert_allclose(sol.xs[1:], 0, rtol=0, atol=1e-14)
    assert_array_equal(sol.modes[1:], 0)
    ts, _ = table(sol)
    assert_allclose(ts[-1], 0.5, rtol=1e-12)
    assert_allclose(ts[:3], [1 / 3, 4 / 9, 13 / 27], rtol=1e-12)


def test_stick_slip_chains_of_the_coulomb_oscillator():
    p = PROBLEMS["coulomb"]
    sol = run(p.system, p.x0, p.t1, p.dt / 2)
    assert_solves(p, sol)
    assert_allclose(sol.xs[-1], p.end, rtol=0, atol=1e-12)


def test_stick_slip_chains_where_one_stick_releases_another():
    p = PROBLEMS["one stick releases another"]
    sol = run(p.system, p.x0, p.t1, p.dt, ts=[0.5, 1.0, 2.0])
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.modes, [[-1, 0], [0, 1], [0, 1]])
    assert_allclose(sol.xs[-1], p.end, rtol=0, atol=1e-14)


def test_leaving_a_slide_at_a_fold():
    # Exact: the circle is met at ln(2/1.01)/2; with φ the angle from (1, -1), φ' = -cot(φ/2)
    # along it, until (-1, -1) where φ = 3π/2.
    meet = 0.5 * np.log(2 / 1.01)
    exit_ = meet - np.log(2) - 2 * np.log(-np.cos(5 * np.pi / 8 - np.arctan(0.1) / 2))
    p = PROBLEMS["visible fold"]
    assert_allclose([meet, exit_], p.ts, rtol=1e-11)

    def error(steps):
        x0 = jnp.asarray(p.x0)
        sol = jf.solve(p.system, x0, 0.0, p.t1, p.t1 / steps, max_events=4)
        _, kinds = table(sol)
        assert kinds == p.kinds
        assert_allclose(sol.events.xs[1], p.before[1], rtol=1e-12)
        return abs(float(sol.events.ts[1]) - exit_)

    steps = np.array([10, 12, 15, 18, 20, 22, 25, 27])
    order = -np.polyfit(np.log(steps), np.log([error(s) for s in steps]), 1)[0]
    assert abs(order - 8) < 0.5


DRY = 0.2


class Reservoir(jf.System):
    """A tank with the outflow a √h and a demand, and the demand that is not met. The inflow grows
    from t = 1 on."""

    flow: jax.Array
    demand: jax.Array
    growth: jax.Array
    clocks = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        inflow = DRY + self.growth * jnp.maximum(t - 1, 0.0)
        out = self.demand + self.flow * jnp.sqrt(jnp.maximum(x[0], 0.0))
        return jnp.where(
            side > 0, jnp.stack([inflow - out, 0 * x[1]]), jnp.stack([inflow, self.demand])
        )

    def switching(self, t, x):
        return x[0]


def test_a_slide_where_a_root_in_the_field_has_no_slope():
    """The tank is empty at 2/a (√h − c/a log(1 + a √h/c)), with c the demand less the inflow, until
    the inflow is the demand. What is not met until then depends on the growth through the end of
    the slide alone."""
    flow, demand, growth, h = 0.6, 0.5, 0.8, 0.3

    def end(growth):
        tank = Reservoir(jnp.asarray(flow), jnp.asarray(demand), growth)
        steps = jf.Adaptive(rtol=1e-10, atol=1e-13)
        sol = jf.solve(tank, jnp.array([h, 0.0]), 0.0, 1.5, steps, max_events=4)
        return sol.x_final[1], (sol.x_final[1], sol.events.ts)

    slope, (missing, times) = jax.jit(jax.jacfwd(end, has_aux=True))(jnp.asarray(growth))
    c = demand - DRY
    empty = 2 / flow * (np.sqrt(h) - c / flow * np.log(1 + flow * np.sqrt(h) / c))
    np.testing.assert_allclose(times[:2], [empty, 1 + c / growth], rtol=0, atol=1e-8)
    exact = c * (1 - empty) + c**2 / (2 * growth)
    np.testing.assert_allclose(missing, exact, rtol=0, atol=1e-8)
    np.testing.assert_allclose(slope, -(c**2) / (2 * growth**2), rtol=0, atol=1e-8)


class Countdown(jf.System):
    """r' = −1 until r = 0, where it stands still, and y, the time since then."""

    sign: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.where(self.sign * side > 0, jnp.stack([t * 0 - 1, 0 * t]), jnp.stack([0 * t, 1]))

    def switching(self, t, x):
        return self.sign * x[0]


def test_a_motion_that_stands_still_on_its_surface_does_not_slide():
    """It comes from either side of H, or starts there."""

    def end(sign, r):
        x0 = jnp.stack([r, 0 * r])
        sol = jf.solve(Countdown(sign), x0, 0.0, 3.0, 0.1, max_events=4)
        return sol.x_final, (sol.x_final, sol.mode_final[0], sol.num_events)

    signs, starts = jnp.array([1.0, -1.0, 1.0, -1.0]), jnp.array([0.5, 0.5, 0.0, 0.0])
    by_start, (x, modes, counts) = jax.jit(jax.vmap(jax.jacfwd(end, 1, has_aux=True)))(
        signs, starts
    )
    assert_allclose(x, np.stack([0 * starts, 3 - starts], axis=1), rtol=0, atol=1e-14)
    assert_array_equal(modes, -signs)
    assert_array_equal(counts, [1, 1, 0, 0])
    assert_allclose(by_start[:2], [[0, -1]] * 2, rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_coupled_motions_that_stand_still_do_not_slide(n):
    """Each that runs takes the later ones along, by a tenth."""

    class Chain(jf.System):
        slides = False

        def vector_field(self, t, x, side):
            runs = 0.5 * (1 + side)
            return jnp.append(-runs - 0.1 * np.tri(n, n, -1) @ runs, jnp.sum(1 - runs))

        def switching(self, t, x):
            return x[:n]

    def end(x0):
        sol = jf.solve(Chain(), x0, 0.0, 1.0, 0.1, throw=False)
        return sol.result, sol.x_final

    starts = np.zeros((2, n + 1))
    starts[1, 0] = 0.3
    results, x = jax.jit(jax.vmap(end))(starts)
    assert_array_equal(outcome_names(results), "successful")
    # The first one runs for a time of 0.3, and the others, below their surfaces then, with it.
    right = np.zeros((2, n + 1))
    right[:, n], right[1, 1:n] = [n, n - 0.3], -0.03
    assert_allclose(x, right, rtol=0, atol=1e-13)


class Refractory(jf.System):
    """v' = I − v, and a spike at v = 1, after which it is deaf while r counts down from tau."""

    current: jax.Array
    refractory: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        deaf = side[1] > 0
        rise, fall = jnp.where(deaf, 0.0, self.current - x[0]), jnp.where(deaf, -1.0, 0.0)
        return jnp.stack([rise, fall])

    def switching(self, t, x):
        return jnp.stack([1 - x[0], x[1]])

    def reset(self, t, x, surface):
        fired = jnp.stack([0 * x[0], 0 * x[1] + self.refractory])
        return jnp.where(surface == 0, fired, x)


@pytest.mark.slow
def test_a_refractory_time_that_is_counted_down():
    """From r = 0.1 the spikes are at 0.1 + w and, with w = log(I/(I − 1)), at 0.1 + 2w + tau."""

    def end(p):
        sol = jf.solve(Refractory(*p), jnp.array([0.0, 0.1]), 0.0, 3.4, 0.05, max_events=16)
        return sol.x_final, (sol.x_final, sol.events.ts, sol.events.kinds)

    def exact(p):
        last = 0.1 + 2 * jnp.log(p[0] / (p[0] - 1)) + p[1]
        return jnp.stack([p[0] * (1 - jnp.exp(last + p[1] - 3.4)), 0.0])

    p = jnp.array([1.5, 0.3])
    slopes, (x, ts, kinds) = jax.jit(jax.jacfwd(end, has_aux=True))(p)
    fired = np.asarray(ts)[np.asarray(kinds) == EventKind.impact]
    assert_allclose(fired, [0.1 + np.log(3), 0.4 + 2 * np.log(3)], rtol=1e-10)
    assert_allclose(x, exact(p), rtol=0, atol=1e-10)
    assert_allclose(slopes, jax.jacfwd(exact)(p), rtol=0, atol=1e-9)
