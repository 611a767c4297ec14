"""Ticks, resets and other surfaces that end a slide or a rest: what holds the state ceases to, and
it moves on at once.

Queues before a light, blocks on dry friction under a switched force, a diode that blocks, a ball
that is lifted off its floor: motions made of parabolas, compared with them, and so are their
derivatives.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil import EventKind
from tests.results import (
    assert_derivatives,
    assert_within,
    kinds_of,
)

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=jf.RK4(), max_events=16, throw=False)
CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip
IMPACT = EventKind.impact


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    x0 = jnp.stack([jnp.asarray(v, float) for v in x0])
    return jf.solve(system, x0, t0, t1, dt, **(OPTIONS | options))


def motion(start, events):
    """The end and the times of so many events, of the run that `start` gives."""

    def numbers(p):
        sol = start(p)
        return jnp.concatenate([sol.x_final, sol.events.ts[:events]]), sol

    return numbers


class Queue(jf.System):
    """Cars before a light that is green in the first half of each of its periods."""

    arrival: jax.Array
    service: jax.Array
    half: jax.Array

    def vector_field(self, t, x, side):
        green = jnp.mod(t, 2 * self.half) < self.half
        return (self.arrival - jnp.where((side > 0) & green, self.service, 0.0))[None]

    def switching(self, t, x):
        return x[0]

    @property
    def clocks(self):
        return (jf.Clock(self.half),)


QUEUES = jnp.array([[0.3, 1.0, 1.0], [0.25, 1.2, 0.97], [0.2, 0.8, 1.05]])


def queue(p, t1=5.7, t0=0.0, x0=0.1, **options):
    return solve(Queue(*p), [x0], t1, t0=t0, **options)


def queue_exact(p):
    """Three times it is empty, three times the light turns red."""
    arrival, service, half = p
    fall = service - arrival
    empty = [0.1 / fall, *((2 * k + arrival / fall) * half for k in (1, 2))]
    ends = [half, 3 * half, 5 * half]
    pairs = zip(empty, ends, strict=True)
    return jnp.stack([arrival * (5.7 - 5 * half), *(t for pair in pairs for t in pair)])


@pytest.mark.slow
def test_a_queue_grows_when_its_light_turns_red():
    run = motion(lambda p: queue(p, compact=True), 6)
    sols = assert_derivatives(run, queue_exact, QUEUES, 256)
    assert kinds_of(sols) == [[STICK, SLIP] * 3] * 3


def test_lanes_of_a_batch_have_ticks_of_their_own():
    sols = jax.jit(jax.vmap(lambda p: queue(p, compact=False)))(QUEUES)
    got = np.concatenate([sols.x_final, sols.events.ts[:, :6]], axis=1)
    assert_within(got, jax.vmap(queue_exact)(QUEUES), 64 * EPS * 5.7)


def test_a_run_goes_on_from_a_tick_that_ends_a_slide():
    """And from where the slide begins."""
    p = QUEUES[0]
    for t in (1.0, 2 + 0.3 / 0.7, 3.0, 4.5):
        first = queue(p, t1=t)
        last = queue(p, t0=t, x0=first.x_final[0])
        count = int(first.num_events), int(last.num_events)
        assert sum(count) == 6
        times = np.concatenate([first.events.ts[: count[0]], last.events.ts[: count[1]]])
        got = np.concatenate([last.x_final, times])
        assert_within(got, queue_exact(p), 64 * EPS * 5.7)


def test_it_does_so_in_float32():
    p = jnp.asarray(QUEUES[0], jnp.float32)
    start = jnp.full(1, 0.1, jnp.float32)
    sol = jf.solve(Queue(*p), start, 0.0, 5.7, 0.1, **OPTIONS)
    got = np.concatenate([sol.x_final, sol.events.ts[:6]])
    assert got.dtype == np.float32
    assert_within(got, queue_exact(QUEUES[0]), 64 * np.finfo(np.float32).eps * 5.7)


@pytest.mark.slow
def test_the_loop_is_run_backward():
    def end(p):
        adjoint = diffrax.RecursiveCheckpointAdjoint()
        return queue(p, adjoint=adjoint, compact=True).x_final[0]

    assert_within(jax.grad(end)(QUEUES[0]), [0.7, 0.0, -1.5], 256 * EPS * 5)


class Crossroads(jf.System):
    """Two queues whose lights are green in turn; the second queue is the first surface."""

    arrivals: jax.Array
    half: jax.Array

    def vector_field(self, t, x, side):
        first = jnp.mod(t, 2 * self.half) < self.half
        served = jnp.where(side[::-1] > 0, 1.0, 0.0) * jnp.where(
            first, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
        )
        return self.arrivals - served

    def switching(self, t, x):
        return x[::-1]

    @property
    def clocks(self):
        return (jf.Clock(self.half),)


def crossroads_exact(p):
    a, b, half = p
    ends = [a * (3.4 - 3 * half), b * half - (1 - b) * (3.4 - 3 * half)]
    empty = [0.1 / (1 - a), half / (1 - b), (2 + a / (1 - a)) * half]
    return jnp.stack([*ends, empty[0], half, empty[1], 2 * half, empty[2], 3 * half])


@pytest.mark.slow
def test_of_two_queues_one_starts_as_the_other_stops():
    """At each tick one slide ends, and another state falls to its surface."""
    lanes = jnp.array([[0.3, 0.4, 1.0], [0.2, 0.35, 1.03]])
    run = motion(lambda p: solve(Crossroads(p[:2], p[2]), [0.1, 0.0], 3.4, compact=True), 6)
    sols = assert_derivatives(run, crossroads_exact, lanes, 256, order=1)
    assert kinds_of(sols) == [[STICK, SLIP] * 3] * 2
    surfaces = np.asarray(sols.events.surfaces[:, :6])
    assert (surfaces == [1, 1, 0, 0, 1, 1]).all()


class Block(jf.System):
    """x'' = u − sgn x', with u = u₀ in the first part D of each period T, and u₁ after it."""

    T: jax.Array
    D: jax.Array
    u0: jax.Array
    u1: jax.Array

    def vector_field(self, t, x, side):
        u = jnp.where(jnp.mod(t, self.T) < self.D * self.T, self.u0, self.u1)
        return jnp.stack([x[1], u - side])

    def switching(self, t, x):
        return x[1]

    @property
    def clocks(self):
        return jf.Clock(self.T), jf.Clock(self.T, self.D * self.T)


def block_exact(p):
    T, D, u0, u1 = p
    gain, loss, s = u1 - 1, 1 - u0, 2.8 - T - D * T
    speed = gain * (1 - D) * T
    x = 0.02 / loss + gain * ((1 - D) * T) ** 2 / 2 + speed**2 / (2 * loss) + gain * s**2 / 2
    return jnp.stack([x, gain * s, 0.2 / loss, D * T, T + speed / loss, T + D * T])


@pytest.mark.slow
def test_a_block_slips_when_its_force_jumps():
    lanes = jnp.array([[1.5, 0.6, 0.5, 1.2], [1.45, 0.63, 0.6, 1.3]])
    run = motion(lambda p: solve(Block(*p), [0.0, 0.2], 2.8, compact=True), 4)
    sols = assert_derivatives(run, block_exact, lanes, 1024)
    assert kinds_of(sols) == [[STICK, SLIP] * 2] * 2


def parabolas(T, D, u0, u1, v, t1):
    """The end of a block's motion, by pieces between ticks and stops."""
    ticks = [k * T for k in range(1, 40)] + [(k + D) * T for k in range(40)]
    t, x = 0.0, 0.0
    for end in [*sorted(s for s in ticks if s < t1), t1]:
        u = u0 if ((t + end) / 2) % T < D * T else u1
        while t < end:
            if v == 0 and abs(u) <= 1:
                break
            a = u - np.sign(v if v else u)
            h = min(end - t, -v / a if v * a < 0 else np.inf)
            stops = h < end - t
            t, x, v = t + h, x + h * (v + a * h / 2), 0.0 if stops else v + a * h
        t = end
    return x, v


def test_blocks_under_any_pulses_move_by_parabolas():
    draw, n = np.random.default_rng(0), 60
    columns = draw.uniform(0.3, 2, n), draw.uniform(0.2, 0.8, n), *draw.uniform(-3, 3, (2, n))
    p, v = np.stack(columns, axis=1), draw.normal(size=n)
    dt = np.where(np.arange(n) % 2, 0.05, 0.13)

    @jax.jit
    @jax.vmap
    def end(p, v, dt):
        sol = solve(Block(*p), [0.0, v], 7.0, dt, compact=True, max_events=None)
        return sol.result, sol.x_final

    results, got = end(*map(jnp.asarray, (p, v, dt)))
    assert (results == jf.RESULTS.successful).all()
    want = [parabolas(*q, w, 7.0) for q, w in zip(p, v, strict=True)]
    # A hundred pieces, over which errors of speed grow with the time that is left.
    assert_within(got, want, 100 * 7 * EPS * np.max(np.abs(want)))


class Diode(jf.System):
    """A buck converter that is discontinuous: current and charge. L = 1; the diode ends the current
    until the source V is there again."""

    source: jax.Array
    load: jax.Array
    D: jax.Array
    T: jax.Array

    def vector_field(self, t, x, side):
        on = jnp.mod(t, self.T) < self.D * self.T
        drop = jnp.where(side > 0, self.load, -self.load)
        return jnp.stack([jnp.where(on, self.source, 0.0) - drop, x[0]])

    def switching(self, t, x):
        return x[0]

    @property
    def clocks(self):
        return jf.Clock(self.T), jf.Clock(self.T, self.D * self.T)


def diode_exact(p):
    source, load, D, T = p
    peak, s = (source - load) * D * T, 2.2 - 2 * T
    charge = peak * source / load * D * T / 2
    ends = [(source - load) * s, 2 * charge + (source - load) * s**2 / 2]
    stops = D * T * source / load
    return jnp.stack([*ends, stops, T, T + stops, 2 * T])


def test_a_diode_conducts_again_when_the_source_is_back():
    lanes = jnp.array([[2.0, 1.2, 0.4, 1.0], [3.0, 1.4, 0.35, 0.98]])
    run = motion(lambda p: solve(Diode(*p), [0.0, 0.0], 2.2, compact=True), 4)
    sols = assert_derivatives(run, diode_exact, lanes, 1024, order=1)
    assert kinds_of(sols) == [[STICK, SLIP] * 2] * 2


class TimerQueue(jf.System):
    """A queue whose service is shut by the reset of a timer: states queue, service, timer."""

    arrival: jax.Array
    stop: jax.Array

    def vector_field(self, t, x, side):
        served = jnp.where(side[0] > 0, x[1], 0.0)
        return jnp.stack([self.arrival - served, 0 * t, 0 * t + 1])

    def switching(self, t, x):
        return jnp.stack([x[0], self.stop - x[2]])

    def reset(self, t, x, surface):
        shut = jnp.stack([x[0], 0 * x[1], x[2] - 5])
        return jnp.where(surface == 0, x, shut)


@pytest.mark.release
def test_a_timer_ends_the_service_of_an_empty_queue():
    def exact(p):
        arrival, stop = p
        rest = [0 * stop, 3 - 5 + 0 * stop]
        return jnp.stack([arrival * (3 - stop), *rest, 0.1 / (1 - arrival), stop, stop])

    run = motion(lambda p: solve(TimerQueue(*p), [0.1, 1.0, 0.0], 3.0, compact=True), 3)
    sols = assert_derivatives(run, exact, [[0.3, 1.0], [0.25, 1.13]], 256, order=1)
    assert kinds_of(sols) == [[STICK, IMPACT, SLIP]] * 2


class TimerBlock(jf.System):
    """x'' = load − sgn x', where the reset of a timer doubles the load: x, x', load, timer."""

    stop: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], x[2] - side[1], 0 * t, 0 * t + 1])

    def switching(self, t, x):
        return jnp.stack([self.stop - x[3], x[1]])

    def reset(self, t, x, surface):
        doubled = jnp.stack([x[0], x[1], 2 * x[2], x[3] - 5])
        return jnp.where(surface == 0, doubled, x)


@pytest.mark.release
def test_a_timer_makes_a_stuck_block_slip():
    def exact(p):
        stop, load = p
        gain, s = 2 * load - 1, 2 - stop
        x = 0.005 / (1 - load) + gain * s**2 / 2
        ends = [x, gain * s, 2 * load, -3 + 0 * stop]
        return jnp.stack([*ends, 0.1 / (1 - load), stop, stop])

    def start(p):
        return solve(TimerBlock(p[0]), [0.0, 0.1, p[1], 0.0], 2.0, compact=True)

    lanes = [[1.0, 0.7], [1.07, 0.8]]
    sols = assert_derivatives(motion(start, 3), exact, lanes, 1024, order=1)
    assert kinds_of(sols) == [[STICK, IMPACT, SLIP]] * 2


class Lift(jf.System):
    """A ball on a floor under the force −a, which turns upward where another mass passes c."""

    a: jax.Array
    c: jax.Array
    slides: ClassVar[bool] = False
    floor: ClassVar[int] = 0

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.a * side[1 - self.floor], 0 * t + 0.8])

    def switching(self, t, x):
        surfaces = [x[0], self.c - x[2]]
        return jnp.stack(surfaces[::-1] if self.floor else surfaces)

    def reset(self, t, x, surface):
        bounced = jnp.stack([x[0], -0.5 * x[1], x[2]])
        return jnp.where(surface == self.floor, bounced, x)


class LiftFromSecond(Lift):
    """The floor is the second surface, and the other one may be slid on."""

    slides = True
    floor = 1


@pytest.mark.slow
@pytest.mark.parametrize("system", [Lift, pytest.param(LiftFromSecond, marks=pytest.mark.release)])
def test_a_ball_is_lifted_where_another_mass_passes(system):
    def exact(p):
        a, c = p
        s = 2 - c / 0.8
        return jnp.stack([a * s**2 / 2, a * s, 1.6 + 0 * c, c / 0.8, c / 0.8])

    run = motion(lambda p: solve(system(*p), [0.0, 0.0, 0.0], 2.0, 0.05, compact=True), 2)
    sols = assert_derivatives(run, exact, [[1.0, 0.8], [1.3, 0.7]], 256, order=1)
    assert kinds_of(sols) == [[CROSS, SLIP]] * 2


class Flipping(jf.System):
    """x' = 0.03 (1 + sgn(x − b)/2) on a band b = ±0.6 that a clock turns round, beside a clock that
    changes no number, and a wall out of reach."""

    fast: jax.Array
    slow: jax.Array
    phase: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([0.03 * (1 + side[0] / 2), 0.0 * t])

    def switching(self, t, x):
        return jnp.stack([x[0] - x[1], 9 - x[0]])

    def reset(self, t, x, surface):
        return x

    def tick(self, t, x, clock):
        return jnp.where(clock == 1, x * jnp.array([1.0, -1.0]), x)

    @property
    def clocks(self):
        return jf.Clock(self.fast), jf.Clock(self.slow, self.phase)


@pytest.mark.release
def test_ticks_that_coincide_but_for_rounding_are_no_turns():
    """Of two clocks that tick together at 2, 5, 8, 11 periods of the first, only the second one
    does anything; x has derivatives by its times alone."""
    fast = np.random.default_rng(0).uniform(0.4, 0.5, 32)
    lanes = jnp.asarray(np.stack([fast, 1.5 * fast, 0.5 * fast], axis=1))

    def exact(p):
        times = p[2] + p[1] * jnp.arange(1.0, 20.0)
        sides = (-1.0) ** jnp.arange(1.0, 20.0)  # of x − b from each of these on
        parts = jnp.where(times < 6.0, sides * 0.03 * (6.0 - times), 0.0)
        return jnp.stack(
            [
                -0.3 + 0.045 * (6.0 - 0.3) + parts.sum(),
                jnp.where((times < 6.0).sum() % 2, 0.6, -0.6),
            ]
        )

    options = dict(t0=0.3, max_events=32, compact=True)
    run = jax.vmap(lambda p: solve(Flipping(*p), [-0.3, -0.6], 6.0, 0.05, **options).x_final)
    slopes = jax.jacfwd(lambda p: run(lanes + p))(jnp.zeros(3))
    assert_within(run(lanes), jax.vmap(exact)(lanes), 64 * EPS)
    assert_within(slopes, jax.vmap(jax.jacfwd(exact))(lanes), 256 * EPS)


class Stepped(jf.System):
    """A rising level and a threshold that jumps between −0.4 and 0.4 at each tick."""

    num_surfaces: int = 1
    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return 0 * x + 0.25

    def switching(self, t, x):
        # The times of these ticks are exact, and a tick belongs to the time after it.
        odd = jnp.floor(t - 0.5) % 2 == 0
        return x[0] - jnp.where(odd, 0.4, -0.4) - 10 * jnp.arange(1.0 * self.num_surfaces)


@pytest.mark.parametrize("num_surfaces", [1, 2])
def test_a_threshold_that_jumps_past_the_state_carries_it(num_surfaces):
    sol = jf.solve(Stepped(num_surfaces), jnp.array([0.1]), 0.0, 1.4, 0.05)
    kinds = [jf.EventKind(int(kind)).name for kind in sol.events.kinds[: sol.num_events]]
    assert kinds == ["carry", "crossing"]
    np.testing.assert_allclose(sol.events.ts[:2], [0.5, 1.2], rtol=1e-13)


class Sampled(jf.System):
    """x' = u − x, with u = 1 − 2x measured at the ticks of a clock."""

    clocks: ClassVar[tuple] = (jf.Clock(1e-3),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1] - x[0], 0 * t])

    def tick(self, t, x, clock):
        return jnp.stack([x[0], 1 - 2 * x[0]])


def test_a_long_run_of_a_fast_clock_needs_no_limit():
    """At rest x = u = 1/3. There are 100 ticks in a step."""
    sol = solve(Sampled(), [0.0, 0.0], 80.0, max_events=None)
    assert sol.result == jf.RESULTS.successful
    assert_within(sol.x_final, [1 / 3, 1 / 3], 512 * EPS)
