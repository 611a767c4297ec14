"""The ends of a span: a run from t0 to t1 has the ticks and contacts in (t0, t1].

Saved states are those just after what happens at their times, runs that are chained anywhere are
the whole run, a start on a surface goes on as from just before it, and a run may end at an impact,
or within rounding of it.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf
from tests.problems.systems import Guided
from tests.results import assert_within, outcome_names, table

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=jf.RK4(), compact=True, max_events=16, throw=False)


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    return jf.solve(system, jnp.asarray(x0, float), t0, t1, dt, **(OPTIONS | options))


class Counter(jf.System):
    """x' = 1; each tick adds 1 to a count."""

    T: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([0 * t, 0 * t + 1])

    def tick(self, t, x, clock):
        return jnp.stack([x[0] + 1, x[1]])

    @property
    def clocks(self):
        return (jf.Clock(self.T),)


class CounterWithSurface(Counter):
    """The same with a surface that is crossed at 1.25."""

    def switching(self, t, x):
        return x[1] - 1.25


class TimerCounter(jf.System):
    """The same by a timer, which a reset sets back."""

    T: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([0 * t, 0 * t + 1])

    def switching(self, t, x):
        return self.T - x[1]

    def reset(self, t, x, surface):
        return jnp.stack([x[0] + 1, x[1] - self.T])


class Sawtooth(jf.System):
    """The same by a reset on a surface in time that jumps itself: met at T/2, 3T/2, …, and back
    again at the ticks, at which the reset counts."""

    T: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([0 * t, 0 * t + 1])

    def switching(self, t, x):
        return jnp.mod(t, self.T) - 0.5 * self.T

    def reset(self, t, x, surface):
        early = jnp.mod(t, self.T) < 0.25 * self.T
        return jnp.stack([x[0] + jnp.where(early, 1.0, 0.0), x[1]])

    @property
    def clocks(self):
        return (jf.Clock(self.T),)


COUNTERS = [Counter, CounterWithSurface, TimerCounter, Sawtooth]


@pytest.mark.slow
@pytest.mark.parametrize("system", COUNTERS)
def test_a_span_is_open_at_its_start_and_closed_at_its_end(system):
    """One run to 3 counts 3, and so do runs that are chained at ticks, and between them."""
    one = system(jnp.asarray(1.0))
    for ends in ([3.0], [1.0, 2.0, 3.0], [0.5, 2.0, 2.3, 3.0], [1.25, 3.0]):
        x, t = jnp.zeros(2), 0.0
        for end in ends:
            sol = solve(one, x, end, t0=t)
            assert sol.result == jf.RESULTS.successful
            x, t = sol.x_final, end
        assert_within(x[0], 3.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("system", COUNTERS)
def test_saved_states_are_those_just_after_a_tick(system):
    ts = jnp.array([0.5, 1.0, 1.5, 2.0, 2.5])
    one = system(jnp.asarray(1.0))
    sol = solve(one, [0.0, 0.0], 3.5, saveat=diffrax.SaveAt(ts=ts))
    assert_array_equal(sol.xs[:, 0], [0, 1, 1, 2, 2])


@pytest.mark.slow
@pytest.mark.parametrize("system", [Counter, TimerCounter])
def test_dense_output_is_that_just_after_a_tick(system):
    sol = solve(system(jnp.asarray(1.0)), [0.0, 0.0], 3.5, saveat=diffrax.SaveAt(dense=True))
    got = [float(sol.evaluate(t)[0]) for t in (0.5, 1.0, 1.5, 2.0, 2.5)]
    assert_array_equal(got, [0, 1, 1, 2, 2])


class Alternating(jf.System):
    """x' = 1 + floor t, on the sides −1 and +1 in turn."""

    tick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return 1 + jnp.floor(t / self.tick)[None]

    def switching(self, t, x):
        return jnp.where(jnp.mod(t / self.tick, 2.0) < 1, -1.0, 1.0) + 0 * x[0]

    @property
    def clocks(self):
        return (jf.Clock(self.tick),)


def number_and_side(t, x, side):
    return jnp.stack([jnp.floor(t), side])


@pytest.mark.parametrize("dt", [0.1, jf.Adaptive()], ids=repr)
def test_backward_in_time_what_is_saved_at_a_tick_is_after_it(dt):
    """In time, as the run that goes forward has it: between steps, at a grid point, at the end."""
    one, ts = Alternating(jnp.asarray(1.0)), jnp.array([2.5, 2.0, 1.5, 1.0])
    saveat, how = diffrax.SaveAt(ts=ts), dict(observe=number_and_side, stepper=diffrax.Dopri5())
    sol = solve(one, [4.5], 1.0, dt, 2.5, saveat=saveat, **how)
    assert_within(sol.xs[:, 0], [4.5, 3.0, 2.0, 1.0], 64 * EPS)
    assert_array_equal(sol.modes[:, 0], [-1, -1, 1, 1])
    assert_array_equal(sol.observed, [[2, -1], [2, -1], [1, 1], [1, 1]])


def test_backward_in_time_dense_output_at_a_tick_is_after_it():
    one, ts = Alternating(jnp.asarray(1.0)), jnp.array([2.5, 2.0, 1.999, 1.0])
    sol = solve(one, [4.5], 1.0, 0.1, 2.5, saveat=diffrax.SaveAt(dense=True))
    assert_within(sol.evaluate(ts)[:, 0], [4.5, 3.0, 2.998, 1.0], 64 * EPS)
    seen = sol.evaluate(ts, observe=number_and_side)
    assert_array_equal(seen, [[2, -1], [2, -1], [1, 1], [1, 1]])


@pytest.mark.parametrize("period", [0.3, 0.7, 0.123456789])
def test_dense_output_at_a_tick_that_is_a_grid_point_but_for_rounding(period):
    """With steps of 0.1 the tick is at 0.7000000000000001."""
    sol = solve(Counter(jnp.asarray(period)), [0.0, 0.0], 3.5, saveat=diffrax.SaveAt(dense=True))
    ticks = period * jnp.arange(1.0, 4.0)
    assert_array_equal(sol.evaluate(ticks)[:, 0], [1, 2, 3])
    assert_array_equal(sol.evaluate(ticks + 0.01)[:, 0], [1, 2, 3])
    assert_array_equal(sol.evaluate(ticks - 0.01)[:, 0], [0, 1, 2])


def test_a_tick_within_rounding_of_a_cut_is_of_one_of_two_runs():
    """The cuts n/10 − 10 have the rounding of 10, by which some are just before a tick."""
    cuts = np.arange(101, 125) / 10 - 10.0

    def count(cut):
        run = dict(dt=0.5, max_events=None)
        first = solve(Counter(0.1), jnp.zeros(2), cut, t0=-10.0, **run)
        return solve(Counter(0.1), first.x_final, 3.03, t0=cut, **run).x_final[0]

    # Those at −9.9, −9.8, …, 3.0.
    assert_array_equal(jax.jit(jax.vmap(count))(jnp.asarray(cuts)), 130)


def test_lanes_count_ticks_of_their_own():
    """Those in (t0, t1], where either may be a tick."""
    T = np.array([1.0, 0.3, 0.7, 0.25, 0.1])
    t0 = np.array([0.0, 0.3, 0.2, 0.5, 0.1])
    t1 = np.array([3.0, 2.1, 2.2, 2.5, 0.7])

    @jax.jit
    @jax.vmap
    def counts(T, t0, t1):
        options = dict(throw=False, stepper=jf.RK4(), max_events=None)
        return jf.solve(Counter(T), jnp.zeros(2), t0, t1, 0.1, **options).x_final[0]

    want = np.floor(t1 / T + 1e-9) - np.floor(t0 / T + 1e-9)
    assert_array_equal(counts(*map(jnp.asarray, (T, t0, t1))), want)


class Thermostat(jf.System):
    """A room whose heater is a memory, set at 22 and at 18."""

    outside: jax.Array
    heater: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([self.outside - x[0] + self.heater * x[1], 0 * x[1]])

    def switching(self, t, x):
        return jnp.stack([22 - x[0], x[0] - 18])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(surface == 0, 0.0, 1.0)])


def room(x0, t0=0.0, t1=1.5):
    system = Thermostat(jnp.asarray(10.0), jnp.asarray(25.0))
    return solve(system, x0, t1, 0.05, t0, stepper=diffrax.Dopri8())


WARMS, COOLS = np.log(15 / 13), np.log(12 / 8)  # from 20 to 22 towards 35; to 18 towards 10


@pytest.mark.slow
def test_a_run_goes_on_from_the_state_recorded_before_a_memory_is_set():
    whole = room([20.0, 1.0])
    again = room(whole.events.xs[0], whole.events.ts[0])
    assert_within(again.x_final, whole.x_final, 256 * EPS * 22)


@pytest.mark.slow
def test_a_run_goes_on_from_the_end_of_one_that_has_set_a_memory():
    whole = room([20.0, 1.0])
    assert_within(whole.events.ts[:2], [WARMS, WARMS + COOLS], 64 * EPS)
    leg = room([20.0, 1.0], t1=whole.events.ts[0])
    assert_array_equal(leg.x_final[1], 0.0)
    rest = room(leg.x_final, leg.t_final)
    assert int(rest.num_events) == int(whole.num_events) - 1
    assert_within(rest.x_final, whole.x_final, 256 * EPS * 22)


@pytest.mark.parametrize("below", [0.0, 1e-12])
def test_a_start_on_a_threshold_is_one_from_just_before_it(below):
    sol = room([22.0 - below, 1.0], t1=0.3)
    assert_within(sol.x_final, [10 + 12 * np.exp(-0.3), 0.0], 64 * EPS * 22 + below)


class Setting(jf.System):
    """A point that moves at a speed v; at 1 a memory is set."""

    value: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0] - 1

    def reset(self, t, x, surface):
        return jnp.stack([x[0], x[1], self.value])


class Highest(Setting):
    """Raised to a value, if it is not above it."""

    def reset(self, t, x, surface):
        return jnp.stack([x[0], x[1], jnp.maximum(x[2], self.value)])


class Direction(Setting):
    """A direction is kept as one, to within rounding."""

    def reset(self, t, x, surface):
        new = jnp.stack([x[1], x[2] + jnp.where(x[2] > 0.5, 0.0, self.value)])
        return jnp.concatenate([x[:1], new / jnp.sqrt(jnp.sum(new**2))])


class Back(Setting):
    """To another place each time, and the reset leads further."""

    def reset(self, t, x, surface):
        return x.at[0].add(-self.value)


class Away(Setting):
    """On the other side, and further."""

    def reset(self, t, x, surface):
        return x.at[0].add(self.value)


class Contrary(Setting):
    """Two surfaces in one place, of which the second undoes what the first has set."""

    def switching(self, t, x):
        return jnp.stack([x[0] - 1, 1 - x[0]])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], x[1], jnp.where(surface == 0, 0.0, self.value)])


@pytest.mark.slow
@pytest.mark.parametrize("system", [Setting, Highest, Direction, Back, Away, Contrary])
def test_chained_just_before_or_after_a_reset_runs_are_the_whole_run(system):
    """A state says whether a reset can have led to it. Of one that can, it has."""
    one, x0 = system(jnp.asarray(2.0)), [0.0, 1.0, 0.25]
    whole = solve(one, x0, 1.75)
    assert whole.result == jf.RESULTS.successful and int(whole.num_events) > 0
    when = whole.events.ts[0]
    before = solve(one, whole.events.xs[0], 1.75, t0=when)
    assert int(before.num_events) == int(whole.num_events)
    assert_within(before.x_final, whole.x_final, 64 * EPS)
    leg = solve(one, x0, when)
    after = solve(one, leg.x_final, 1.75, t0=when)
    assert int(leg.num_events) + int(after.num_events) == int(whole.num_events)
    assert_within(after.x_final, whole.x_final, 64 * EPS)


class Gap(Setting):
    """A kick at a level, passed in either direction."""

    level: jax.Array

    def switching(self, t, x):
        return x[0] - self.level

    def reset(self, t, x, surface):
        return x.at[1].add(self.value)


class Rough(Setting):
    """An acceleration beyond a level, above or below it by its sign, and no reset."""

    level: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.where(side * self.value > 0, self.value, 0.0), 0 * t])

    def switching(self, t, x):
        return x[0] - self.level

    reset = jf.System.reset


@pytest.mark.parametrize("system", [Gap, Rough])
@pytest.mark.slow
def test_a_contact_within_rounding_of_a_cut_is_of_one_of_two_runs(system):
    """The rounding is that of the level, of the last step, or of the whole motion."""
    level = np.array([1000.0, 1.0, 1.0, 1e-3, 0.0])
    x0, v = np.array([990.0, -8.0, 1.1, -1.0, 1.0]), np.array([9.37, 170.0, -3.0, 1.7, -1.7])
    kick, meets = np.array([0.5, -20.0, -2.0, 0.3, 0.4]), (level - x0) / v
    kick = kick if system is Gap else abs(kick) * np.sign(v)
    rounding = 16 * EPS * (abs(level) + 0.1 * abs(v) + abs(x0)) / abs(v)
    cuts = meets + np.linspace(-3, 3, 121)[:, None] * rounding
    ends = np.broadcast_to(1.5 * meets, cuts.shape)

    @jax.jit
    @jax.vmap
    @jax.vmap
    def chained(level, x0, v, kick, cut, end):
        def velocity(x0):
            one, options = system(kick, level), dict(dt=0.05, max_events=4)
            first = solve(one, jnp.stack([x0, v, 0.0]), cut, **options)
            second = solve(one, first.x_final, end, t0=cut, **options)
            return second.x_final[1], (first.num_events, second.num_events)

        return jax.value_and_grad(velocity, has_aux=True)(x0)

    given = [np.broadcast_to(g, cuts.shape) for g in (level, x0, v, kick)]
    (speeds, (first, second)), slopes = chained(*given, cuts, ends)
    assert_array_equal(first + second, 1)
    # The time beyond the level grows by 1/v with x0.
    want, slope = (v + kick, 0 * v) if system is Gap else (v + 0.5 * meets * kick, kick / v)
    assert_within(speeds, np.tile(want, (121, 1)), 1e-12 * (1 + abs(want)))
    assert_within(slopes, np.tile(slope, (121, 1)), 1e-9)


class Rooted(jf.System):
    """A speed of 1 below 0, and above it one that is not a number at the start."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, jnp.sqrt(x + 0.5), 1.0)

    def switching(self, t, x):
        return x[0]


def test_a_start_beside_a_field_that_is_not_a_number_crosses_into_it():
    sol = solve(Rooted(), [-1.0], 1.5)
    assert int(sol.num_events) == 1
    assert_within(sol.x_final, [(0.25 + np.sqrt(0.5)) ** 2 - 0.5], 1e-6)


class InTime(Setting):
    def switching(self, t, x):
        return t - 1


class Held(Setting):
    """The same with a clock."""

    def switching(self, t, x):
        return jnp.zeros((0,))

    def tick(self, t, x, clock):
        return jnp.stack([x[0], x[1], self.value])

    @property
    def clocks(self):
        return (jf.Clock(jnp.asarray(1.0)),)


@pytest.mark.parametrize("system", [InTime, Held])
def test_what_is_set_at_a_known_time_is_of_the_run_that_ends_there(system):
    one = system(jnp.asarray(2.0))
    assert solve(one, [0.0, 1.0, 0.25], 1.0).x_final[2] == 2.0
    assert solve(one, [1.0, 1.0, 0.25], 1.5, t0=1.0).x_final[2] == 0.25


class Drop(jf.System):
    """A ball above a floor; in a system of two surfaces, the first of which is far away."""

    g: jax.Array
    e: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.g])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -self.e * x[1]])


class DropOfTwo(Drop):
    def switching(self, t, x):
        return jnp.stack([1000 - x[0], x[0]])


def drops(system, g, e, h, t1, dt):
    def one(g, e, h, t1):
        return solve(system(g, e), jnp.stack([h, 0 * h]), t1, dt, max_events=8)

    return jax.jit(jax.vmap(one))(*map(jnp.asarray, (g, e, h, t1)))


@pytest.mark.slow
@pytest.mark.parametrize("system", [Drop, DropOfTwo])
def test_a_ball_without_restitution_lies_where_it_lands(system):
    """On a grid point in every second lane."""
    draw, n, dt = np.random.default_rng(0), 300, 0.02
    k = draw.integers(1, 48, n) + np.where(np.arange(n) % 2, draw.uniform(0.05, 0.95, n), 0.0)
    g = draw.uniform(0.05, 3, n)
    sols = drops(system, g, 0 * g, g * (k * dt) ** 2 / 2, 1 + 0 * g, dt)
    assert set(outcome_names(sols.result)) == {"successful"}
    assert_within(sols.x_final, np.zeros((n, 2)), 8 * EPS)


@pytest.mark.slow
@pytest.mark.parametrize("system", [Drop, DropOfTwo])
def test_a_run_may_end_at_an_impact(system):
    """Or within rounding of it, before or after; with any restitution."""
    draw, offsets = np.random.default_rng(1), np.array([0, 1, -1, 10, -10, 30, -30, 1e3, -1e3, 1e4])
    n = 20 * offsets.size
    offset = np.tile(offsets, 20) * 1e-16
    g, h = draw.uniform(0.05, 3, n), draw.uniform(0.1, 2, n)
    e = np.where(draw.random(n) < 0.3, 0.0, draw.uniform(0.1, 0.9, n))
    lands = np.sqrt(2 * h / g)
    sols = drops(system, g, e, h, lands * (1 + offset), 0.05)
    assert set(outcome_names(sols.result)) == {"successful"}
    speed = g * lands
    # What it moves in the time that the span is longer or shorter, and rounding of the way.
    way = 64 * EPS * h + 2 * speed * lands * abs(offset)
    assert (abs(sols.x_final[:, 0]) <= way).all()
    v = np.asarray(sols.x_final[:, 1])
    off = np.minimum(abs(v + speed), abs(v - e * speed))
    assert (off <= 64 * EPS * speed + 2 * g * lands * abs(offset)).all()
    late = offset > 1e-14
    assert (v[late] >= 0).all() and (v[offset < -1e-14] < 0).all()


def test_chained_at_impacts_runs_are_the_whole_run():
    ball = Drop(jnp.asarray(2.0), jnp.asarray(0.5))
    whole = solve(ball, [1.0, 0.0], 2.6)
    times = [1.0, 2.0, 2.5, 2.6]
    assert_within(table(whole)[0], times[:3], 64 * EPS)
    x, t, count = jnp.array([1.0, 0.0]), 0.0, 0
    for end in times:
        sol = solve(ball, x, end, t0=t)
        x, t, count = sol.x_final, end, count + int(sol.num_events)
    assert count == int(whole.num_events)
    assert_within(x, whole.x_final, 64 * EPS)


class Kicked(Drop):
    """A ball that each tick throws down, with impacts that die out in one period T."""

    kick: jax.Array
    T: jax.Array

    def tick(self, t, x, clock):
        return jnp.stack([x[0], x[1] - self.kick])

    @property
    def clocks(self):
        return (jf.Clock(self.T),)


class KickedOfTwo(Kicked):
    def switching(self, t, x):
        return jnp.stack([1000 - x[0], x[0]])


@pytest.mark.slow
@pytest.mark.parametrize("system", [Kicked, KickedOfTwo])
def test_impacts_that_die_out_at_a_tick_go_on_from_there(system):
    """After each tick the ball leaves the floor with e·kick; the time to its rest is
    2 e·kick/(g (1 − e)) = T. Runs that are chained at ticks are the whole run."""
    draw, n = np.random.default_rng(3), 64
    e, T = draw.uniform(0.2, 0.7, n), draw.uniform(0.3, 0.7, n)
    kick = draw.uniform(0.2, 1.0, n)
    e[:8], T[:8], kick[:8] = 0.5, 0.5, 0.5
    g = 2 * e * kick / (T * (1 - e))

    @jax.jit
    @jax.vmap
    def leg(g, e, kick, T, x, k, end):
        one = system(g, e, kick, T)
        return solve(one, x, (k + end) * T, t0=k * T, max_events=400)

    start, zero = np.stack([0 * e, e * kick], 1), np.zeros(n)
    for k in range(1, 7):
        sols = leg(g, e, kick, T, start, zero, zero + k)
        assert set(outcome_names(sols.result)) == {"successful"}
        # No rounding of a limit's time moves the ball off the floor.
        assert_within(sols.x_final[:, 0], zero, EPS)
        assert_within(sols.x_final[:, 1], e * kick, 64 * EPS * k)
        after, flight = leg(g, e, kick, T, sols.x_final, zero + k, zero + 0.01), 0.01 * T
        rise = flight * (e * kick - g * flight / 2)
        assert_within(after.x_final[:, 0], rise, 64 * EPS * (k + 1))


@pytest.mark.slow
def test_a_run_goes_on_at_rest_on_a_curved_wall():
    """One projection after a coarse step leaves H = −8e-16, four times its rounding, from where the
    ball would fall through."""
    T = 2 * np.pi

    def run(x, t0, t1):
        kept = dict(stepper=jf.RK4(), max_events=64, compact=True)
        return jf.solve(Guided(jnp.asarray(0.4)), x, t0, t1, T / 20, **kept)

    first = run(jnp.zeros(3), 0.0, 9 * T)
    q, _, s = first.x_final
    assert abs(q - 0.5 * s**2) <= 4 * np.finfo(float).eps * abs(q)
    after, whole = run(first.x_final, 9 * T, 10 * T), run(jnp.zeros(3), 0.0, 10 * T)
    assert after.mode_final.tolist() == whole.mode_final.tolist() == [2]
    np.testing.assert_allclose(after.x_final, whole.x_final, rtol=1e-13)


def test_states_saved_at_the_times_of_impacts_are_those_after_them():
    """Of one surface too, whatever the rounding of the times."""
    draw, n = np.random.default_rng(5), 32
    g, e = draw.uniform(0.5, 9.0, n), draw.uniform(0.5, 0.95, n)
    first = np.sqrt(2 / g)
    # The k-th impact is 2 e + … + 2 eᵏ⁻¹ falls after the first one.
    times = first[:, None] * (1 + 2 * np.cumsum(e[:, None] ** np.arange(1, 6), axis=1))

    @jax.jit
    @jax.vmap
    def saved(g, e, ts):
        options = OPTIONS | dict(saveat=diffrax.SaveAt(ts=ts), max_events=64)
        return jf.solve(Drop(g, e), jnp.array([1.0, 0.0]), 0.0, ts[-1], 0.05, **options)

    # First at times in closed form, then at those that the runs have found.
    for ts in (times, np.asarray(saved(g, e, times).events.ts)[:, 1:6]):
        sols = saved(g, e, ts)
        assert set(outcome_names(sols.result)) == {"successful"}
        after = (e[:, None] ** np.arange(2, 7)) * (g * first)[:, None]
        assert_within(np.asarray(sols.xs)[..., 1], after, 1e-11)
