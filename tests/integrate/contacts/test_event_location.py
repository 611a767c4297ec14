"""Contacts that have broken trusted codes: one test a case, against answers by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil import RESULTS, EventKind
from jaxfil.integrate.contacts.guards import NOISE
from tests.problems import PROBLEMS, closed_forms, tagged
from tests.problems.systems import LEVELS, affine, corner, roots
from tests.results import DEFAULT, assert_solves, rounding_of_steps, run, solved, table


@pytest.mark.slow
@pytest.mark.parametrize("name", [*tagged("hand crossing"), *tagged("hand graze")])
def test_a_problem_has_its_known_motion(name):
    assert_solves(PROBLEMS[name], solved(PROBLEMS[name]))


@pytest.mark.parametrize(("speeds", "end", "side"), [((1, 2), 1, 1), ((-1, -2), -2, -1)])
@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_starts_on_the_surface_and_crosses(speeds, end, side, dt):
    sol = run(affine((1, speeds[0]), (-1, speeds[1])), (0, 0), 1.0, dt)
    assert sol.result == RESULTS.successful
    assert sol.num_events == 0
    assert_array_equal(sol.modes[:, 0], side)
    assert_allclose(sol.xs[-1], [side, end], rtol=1e-14)


@pytest.mark.parametrize(("speeds", "weight"), [((-1, 1), 1 / 2), ((-1, 3), 3 / 4)])
def test_starts_on_the_surface_and_slides(speeds, weight):
    sol = run(affine((3, speeds[0]), (1, speeds[1])), (0, 0), 1.0, 0.3)
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.modes[:, 0], 0)
    assert_array_equal(sol.xs[:, 1], 0)
    assert_allclose(sol.xs[-1, 0], 3 * weight + 1 - weight, rtol=1e-14)


@pytest.mark.parametrize("dt", [1.0, 0.5, 0.25, 0.2, 0.1, 0.3])
def test_contact_exactly_on_a_grid_point_or_a_saved_time(dt):
    p = PROBLEMS["contact on a grid point"]
    sol = run(p.system, p.x0, p.t1, dt, ts=[0.5, 1.0, 1.5])
    ts, kinds = table(sol)
    assert_allclose(ts, p.ts, rtol=1e-14)
    assert kinds == p.kinds
    assert_allclose(sol.xs, [[0.5, 0.5], [1, 0], p.end], rtol=0, atol=1e-14)
    assert_array_equal(sol.modes[:, 0], [1, -1, -1])


@pytest.mark.parametrize("dt", [1.0, 0.5, 0.25, 0.2, 0.1, 0.3])
def test_impact_on_a_saved_time_saves_the_right_limit(dt):
    # From 4.9 at g = 9.8 the floor is reached at t = 1 with speed 9.8 (exact).
    ball = jf.systems.BouncingBall(g=9.8, restitution=0.5)
    sol = run(ball, (4.9, 0), 1.5, dt, ts=[0.5, 1.0, 1.5])
    ts, kinds = table(sol)
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert kinds == [EventKind.impact]
    assert_allclose(sol.xs[1], [0, 4.9], rtol=0, atol=1e-12)
    assert_allclose(sol.xs[2], [1.225, 0], rtol=0, atol=1e-12)
    assert_allclose(sol.events.xs[0], [0, -9.8], rtol=0, atol=1e-12)


def test_same_contact_again_after_the_switch():
    # Bounces at t1 (1 + 2 (e + ... + e^k)), t1 = 10/7: the sixth at 11.96, the seventh at 13.48.
    ball = PROBLEMS["bouncing ball"].system
    dts = jnp.asarray([0.003, 0.01, 0.1, 0.5, 1.0, 2.6, 13.0])
    sols = jax.vmap(
        lambda dt: jf.solve(ball, jnp.asarray([10.0, 0.0]), 0.0, 13.0, dt, max_events=8)
    )(dts)
    assert_array_equal(sols.num_events, 6)
    want = np.broadcast_to(closed_forms.bounces(0.9, 6), (7, 6))
    assert_allclose(sols.events.ts[:, :6], want, rtol=1e-12)
    assert_array_equal(sols.events.kinds[:, :6], EventKind.impact)


@pytest.mark.parametrize("timed", [0, 1])
@pytest.mark.parametrize(
    "times",
    [(0.3, 0.6), (0.5, 0.501), (0.0001, 0.9999), (0.1, 0.4, 0.8), (0.45, 0.5, 0.56)],
)
def test_several_roots_of_one_surface_in_a_step(times, timed):
    sol = run(roots(times, timed), (0, 0), 1.0, 1.0)
    ts, kinds = table(sol)
    assert_allclose(ts, times, rtol=1e-11)
    assert kinds == [EventKind.crossing] * len(times)
    pieces = np.diff([0, *times, 1]) * (-1) ** np.arange(len(times), -1, -1)
    assert_allclose(sol.xs[-1], [1, pieces.sum()], rtol=0, atol=1e-11)


def test_several_roots_of_one_surface_in_a_step_of_a_curved_motion():
    # x = cos t dips below -0.999 for 0.09 around pi, within the step from 3 to 3.5.
    turn = ((0, 1), (-1, 0))
    sol = run(affine((0, 0), (0, 0), turn, turn, n=(1, 0), c=-0.999), (1, 0), 5.0, 0.5)
    ts, kinds = table(sol)
    assert_allclose(ts, [np.arccos(-0.999), 2 * np.pi - np.arccos(-0.999)], rtol=1e-7)
    assert kinds == [EventKind.crossing] * 2


@pytest.mark.parametrize(("levels", "end"), [((0.4, 0.9), -7.8), ((0.9, 0.4), 1.2)])
@pytest.mark.parametrize("dt", [1.0, 0.17])
@pytest.mark.slow
def test_two_surfaces_in_one_step(levels, end, dt):
    # x' = side_1 + 10 side_2: the order of the contacts is in x(1).
    system = corner(lambda s1, s2: (s1 + 10 * s2, 1), LEVELS, levels)
    sol = run(system, (0, 0), 1.0, dt)
    ts, _ = table(sol)
    assert_allclose(ts, [0.4, 0.9], rtol=1e-14)
    assert_array_equal(sol.events.surfaces[:2], np.argsort(levels))
    assert_array_equal(sol.events.members[:2], np.argsort(levels)[:, None] == [0, 1])
    assert_allclose(sol.xs[-1], [end, 1], rtol=1e-13)


@pytest.mark.parametrize("mixed", [lambda s1, s2: (1.5 + s1 / 2, 2 + s2), lambda s1, s2: (1, 2)])
@pytest.mark.parametrize("dt", [0.3, 0.5, 2.0])
def test_both_surfaces_at_once(mixed, dt):
    # (1, 1) before the corner, (2, 3) after it; what the other two quadrants say is not seen.
    corners = {(-1, -1): (1, 1), (1, 1): (2, 3)}
    system = corner(lambda s1, s2: corners.get((s1, s2), mixed(s1, s2)))
    sol = run(system, (-1, -1), 2.0, dt)
    ts, kinds = table(sol)
    # One after the other, unless that leads elsewhere.
    count = len(ts)
    assert_allclose(ts, [1.0] * count, rtol=1e-14)
    assert kinds == [EventKind.crossing] * count
    assert_array_equal(np.asarray(sol.events.members[:count]).sum(axis=0), [1, 1])
    assert sol.events.surfaces[0] == 0
    assert_allclose(sol.xs[-1], [2, 3], rtol=1e-13)
    assert_array_equal(sol.modes[-1], [1, 1])


@pytest.mark.parametrize("dt", [0.3, 2.0])
def test_both_surfaces_at_once_the_same_surface_listed_twice(dt):
    system = corner(lambda s1, s2: (1, 1.5 + (s1 + s2) / 4), n=LEVELS)
    sol = run(system, (0, -1), 2.0, dt)
    ts, _ = table(sol)
    assert_allclose(ts, [1.0, 1.0], rtol=1e-14)
    assert_array_equal(sol.events.members[:2], np.eye(2, dtype=bool))
    assert_allclose(sol.xs[-1], [2, 2], rtol=1e-13)
    assert_array_equal(sol.modes[-1], [1, 1])


def test_both_surfaces_at_once_sliding_on_a_surface_listed_twice():
    system = corner(lambda s1, s2: (1, -(s1 + s2) / 2), n=LEVELS)
    sol = run(system, (0, -1), 2.0, 0.3)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.xs[-1], [2, 0], rtol=0, atol=1e-14)
    assert sol.num_events == 1


@pytest.mark.parametrize("dt", [0.05, 0.3, 0.5, 1.0, 2.0])
def test_grazing_touch(dt):
    p = PROBLEMS["grazing touch"]
    sol = run(p.system, p.x0, p.t1, dt)
    ts, kinds = table(sol)
    assert sol.result == RESULTS.successful
    assert kinds == p.kinds
    assert_allclose(ts, p.ts, rtol=0, atol=1e-6)
    assert_array_equal(sol.modes[:, 0], 1)
    assert_allclose(sol.xs[-1], p.end, rtol=1e-13)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("dt", [0.3, 0.5, 2.0])
def test_grazing_touch_missed_by_a_little(gap, dt, stepper=DEFAULT):
    system = PROBLEMS["grazing touch of one field"].system
    above, below = (run(system, (-1, 1 + s * gap), 2.0, dt) for s in (1, -1))
    assert above.num_events == 0
    ts, kinds = table(below)
    assert kinds == [EventKind.crossing] * 2
    # A contact is where H is within its rounding, 32 eps of its terms; steps add their own. None
    # of these terms is larger than 1, and there dH/dt = ∓2√gap. (And t itself is rounded.)
    h_error = np.finfo(float).eps * (NOISE + rounding_of_steps(stepper))
    atol = h_error / (2 * np.sqrt(gap)) + 1e-15
    assert_allclose(ts, [1 - np.sqrt(gap), 1 + np.sqrt(gap)], rtol=0, atol=atol)


class Comparator(jf.System):
    """x' = 1 − x while a ramp of the given period is above x, −x below."""

    period_: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return 0.5 * (1 + side) - x

    def switching(self, t, x):
        return jnp.mod(t, self.period_) - x[0]


class SlidingComparator(Comparator):
    """The same, where sliding is looked for: the state is not projected to where H has been."""

    slides = True


@pytest.mark.parametrize("kind", [Comparator, SlidingComparator])
@pytest.mark.parametrize("dt", [0.07, 0.1, 0.25])
def test_a_jump_of_h_at_a_known_time_is_a_contact(kind, dt):
    # Below the ramp from x = r at t = r on; at t = 1, 2, 3 the ramp falls to zero.
    system = kind(jnp.asarray(1.0))
    sol = jf.solve(system, jnp.array([0.5]), 0.0, 3.0 - 1e-9, dt)
    r, want = brentq(lambda t: t - 0.5 * np.exp(-t), 0, 1, xtol=1e-15), []
    x = 0.5 * np.exp(-r)
    for _ in range(2):
        x = 1 - (1 - x) * np.exp(r - 1)
        want += [r, 1.0]
        peak = x
        r = brentq(lambda t, peak=peak: t - peak * np.exp(-t), 0, 1, xtol=1e-15)
        x = peak * np.exp(-r)
    want = np.array(want) + np.array([0, 0, 1, 1])
    np.testing.assert_allclose(sol.events.ts[:4], want, rtol=1e-12)
    assert int(sol.num_events) == 5
    x = 1 - (1 - x) * np.exp(r - 1)
    np.testing.assert_allclose(sol.x_final, [x], rtol=1e-8)


class Passing(jf.System):
    """x1' = 1, x2' = side0 + 10 side1: one surface at x1 = a, the other at t = 1/2."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(t), side[0] + 10 * side[1]])

    def switching(self, t, x):
        return jnp.stack([x[0] - self.a, t - 0.5])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.05, 0.25, 0.3, 0.5])
def test_a_contact_at_a_grid_point_hides_none_in_its_step(dt):
    a = jnp.linspace(0.01, 0.99, 99)
    run = lambda a: jf.solve(Passing(a), jnp.zeros(2), 0.0, 1.0, dt, throw=False)  # noqa: E731
    sols = jax.vmap(run)(a)
    assert np.all(np.asarray(sols.result == jf.RESULTS.successful))
    np.testing.assert_allclose(sols.x_final[:, 1], 1 - 2 * a, rtol=0, atol=1e-13)


class BallAndBead(jf.System):
    """A ball above a floor, and a bead that runs into a wall: neither knows of the other."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -10.0 + 0 * x[0], x[3], 0 * x[3]])

    def switching(self, t, x):
        return jnp.stack([x[0], 1 - x[2]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x.at[1].multiply(-0.9), x.at[3].multiply(-1.0))


@pytest.mark.release
@pytest.mark.parametrize("lag", [0.3, 1e-2, 1e-3])
def test_a_contact_that_lands_at_once_hides_no_earlier_one(lag):
    place = np.array([0.003, 0.03, 0.1, 0.3, 0.7])[:, None]
    floor = (0.1 * place * np.linspace(0.8, 1.2, 20)).ravel()
    speed = np.tile(np.linspace(0.0, 0.5, 20), 5)
    height = speed * floor + 5 * floor**2
    x0 = np.stack([height, -speed, 0 * height, 1 / (floor * (1 + lag))], axis=1)
    run = lambda x: jf.solve(BallAndBead(), x, 0.0, 0.1, 0.1, throw=False)  # noqa: E731
    sols = jax.vmap(run)(jnp.asarray(x0))
    assert np.all(np.asarray(sols.result == jf.RESULTS.successful))
    np.testing.assert_allclose(sols.events.ts[:, 0], floor, rtol=1e-10)
    assert np.all(np.asarray(sols.x_final[:, 0]) > -1e-15)


class Decay(jf.System):
    """x' = −x above 1/2 and −x − 0.3 below it."""

    def vector_field(self, t, x, side):
        return -x - 0.15 * (1 - side)

    def switching(self, t, x):
        return x[0] - 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype, start", [("float64", 1e9), ("float64", 1e14), ("float32", 1e5), ("float32", 1e8)]
)
def test_a_large_transient_is_forgotten(dtype, start):
    # What rounding of the largest state would do to H has decayed with that state.
    t1 = np.log(2 * start) + 5
    x0 = jnp.array([start], dtype)
    sol = jf.solve(Decay(), x0, 0.0, t1, 0.05, estimate_error=True)
    assert np.asarray(sol.events.kinds)[:2].tolist() == [EventKind.crossing, EventKind.none]
    error = abs(float(sol.x_final[0]) - (0.8 * np.exp(-5) - 0.3))
    assert error < 100 * np.finfo(dtype).eps
    assert error < 10 * float(sol.errors[0, 0])


class Launch(jf.System):
    """Full thrust up to a speed of 1, half of it after it."""

    thrust: jax.Array

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[2:], self.thrust * jnp.where(side > 0, 0.5, 1.0)])

    def switching(self, t, x):
        return jnp.linalg.norm(x[2:]) - 1.0


def launched(thrust):
    """The state at t = 2, from rest at 0."""
    size = jnp.linalg.norm(thrust)
    rest = 2.0 - 1.0 / size
    speed, way = 1 + 0.5 * size * rest, 0.5 / size + rest + 0.25 * size * rest**2
    return jnp.concatenate([way * thrust / size, speed * thrust / size])


@pytest.mark.release
def test_a_run_may_start_where_a_distant_surface_has_no_gradient():
    thrusts = jnp.array([[0.6, 0.8], [1.0, 0.0], [0.0, -2.0]])

    def end(thrust):
        return jf.solve(Launch(thrust), jnp.zeros(4), 0.0, 2.0, 0.1).x_final

    for function, exact in ((end, launched), (jax.jacfwd(end), jax.jacfwd(launched))):
        found = jax.jit(jax.vmap(function))(thrusts)
        assert_allclose(found, jax.vmap(exact)(thrusts), rtol=0, atol=1e-13)
