"""Avalanches: what one reset or tick carries the state across has its contact at that time.

Neurons that fire each other (J. J. Hopfield and A. V. M. Herz, PNAS 92 (1995) 6655–6662), a gear
box that shifts twice, a gate that opens before something goes through it. Against closed forms, and
five neurons against a loop in plain Python.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf
from jaxfil import EventKind
from tests.oracles import clocked_problems
from tests.results import assert_derivatives, assert_within, kinds_of, table

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=diffrax.Midpoint(), compact=True, max_events=32, throw=False)
IMPACT, CARRY, TICK = EventKind.impact, EventKind.carry, EventKind.tick


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    x0 = jnp.stack([jnp.asarray(v, float) for v in x0])
    return jf.solve(system, x0, t0, t1, dt, **(OPTIONS | options))


def surfaces_of(sol):
    return np.asarray(sol.events.surfaces)[: int(sol.num_events)].tolist()


class Neurons(jf.System):
    """Neuron j integrates at its rate; at 1 it fires, is set to 0, and kicks all others."""

    rates: jax.Array
    kick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return self.rates + 0 * x

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        return (x + self.kick).at[surface].set(0.0)


def pair_exact(p):
    """Neuron 0 fires at 1/r and carries neuron 1 past its threshold, which kicks neuron 0 back."""
    r, s, kick, _ = p
    fires = 1 / r
    return jnp.stack([kick + r * (1.5 - fires), s * (1.5 - fires), fires, fires])


@pytest.mark.release
def test_a_neuron_that_is_kicked_past_its_threshold_fires():
    def end(p):
        r, s, kick, x1 = p
        sol = solve(Neurons(jnp.stack([r, s]), kick), [0 * r, x1], 1.5)
        return jnp.concatenate([sol.x_final, sol.events.ts[:2]]), sol

    lanes = [[1.0, 0.05, 0.2, 0.9], [0.9, 0.06, 0.25, 0.85]]
    sols = assert_derivatives(end, pair_exact, lanes, 256, order=1)
    assert_array_equal(sols.events.surfaces[:, :2], [[0, 1]] * 2)
    assert kinds_of(sols) == [[IMPACT, IMPACT]] * 2


def avalanches(x, rates, kick, t1):
    """Times, neurons and the end: the fastest to its threshold fires, then all that are past
    theirs, each once, the lowest number first."""
    x, t, fired = np.array(x), 0.0, []
    while True:
        waits = (1 - x) / rates
        wait = waits.min()
        if t + wait > t1:
            return fired, x + rates * (t1 - t)
        x, t = x + rates * wait, t + wait
        due, done = [int(waits.argmin())], np.zeros(x.size, bool)
        while due:
            j = due[0]
            x, done[j] = np.where(np.arange(x.size) == j, 0.0, x + kick), True
            fired.append((t, j))
            due = [i for i in range(x.size) if x[i] > 1 and not done[i]]


@pytest.mark.release
def test_five_neurons_fire_as_a_plain_loop_says():
    """In lanes that fire at times of their own, with avalanches of up to five."""
    draw, n = np.random.default_rng(1), 12
    x, rates = draw.uniform(0, 0.95, (n, 5)), draw.uniform(0.5, 1.5, (n, 5))
    kicks, t1 = draw.uniform(0.02, 0.18, n), 2.0
    known = [avalanches(*lane, t1) for lane in zip(x, rates, kicks, strict=True)]
    sizes = [np.unique([t for t, _ in fired], return_counts=True)[1].max() for fired, _ in known]
    assert max(sizes) >= 4

    @jax.jit
    @jax.vmap
    def motion(x, rates, kick):
        return jf.solve(Neurons(rates, kick), x, 0.0, t1, 0.1, **(OPTIONS | dict(max_events=64)))

    sols = motion(*map(jnp.asarray, (x, rates, kicks)))
    assert (sols.result == jf.RESULTS.successful).all()
    for k, (fired, end) in enumerate(known):
        count = len(fired)
        assert int(sols.num_events[k]) == count
        assert_array_equal(sols.events.surfaces[k, :count], [j for _, j in fired])
        assert_within(sols.events.ts[k, :count], [t for t, _ in fired], 256 * EPS * t1)
        assert_within(sols.x_final[k], end, 1024 * EPS)


class Gears(jf.System):
    """Speed, gear and revolutions: a shift multiplies the revolutions by 2, and past 1.5 of them
    there is another; the surfaces are those of the gears in either order."""

    rate: jax.Array
    first: int = eqx.field(static=True, default=0)

    def vector_field(self, t, x, side):
        return jnp.stack([0 * t, 0 * t + self.rate])

    def switching(self, t, x):
        levels = jnp.array([1.0, 1.5, 20.0])
        return (levels if self.first == 0 else levels[::-1]) - x[1]

    def reset(self, t, x, surface):
        return jnp.stack([x[0] + 1, 2 * x[1]])


@pytest.mark.release
@pytest.mark.parametrize("first", [0, pytest.param(2, marks=pytest.mark.release)])
def test_a_gear_box_shifts_twice(first):
    """At 1 from the first gear to the second, whose revolutions, 2, ask for the third: 4."""

    def end(p):
        sol = solve(Gears(p[0], first), [1.0, 0.1], 1.5)
        return jnp.concatenate([sol.x_final, sol.events.ts[:2]]), sol

    def exact(p):
        (rate,) = p
        shift = 0.9 / rate
        return jnp.stack([3 + 0 * rate, 4 + rate * (1.5 - shift), shift, shift])

    sols = assert_derivatives(end, exact, [[1.0], [1.2]], 256, order=1)
    assert kinds_of(sols) == [[IMPACT, IMPACT]] * 2
    assert_array_equal(sols.events.surfaces[:, :2], [[first, 1]] * 2)


class Sided(jf.System):
    """A kick at t = 1 carries x over 1, where its rate changes sign; only the kick has a map."""

    kick: jax.Array
    rate: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return self.rate * side[1:]

    def switching(self, t, x):
        return jnp.stack([t - 1, 1 - x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, x + self.kick, x)


class SidedByTick(Sided):
    """The same by a tick, and no reset: a surface alone."""

    resets: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return self.rate * side

    def switching(self, t, x):
        return 1 - x

    def tick(self, t, x, clock):
        return x + self.kick

    @property
    def clocks(self):
        return (jf.Clock(10.0, 1.0),)


@pytest.mark.slow
@pytest.mark.parametrize("system", [Sided, SidedByTick])
def test_the_field_is_that_of_the_side_it_is_carried_to(system):
    def end(p):
        sol = solve(system(*p), [0.5], 2.0, sections=jf.Section(lambda t, x: x[0] - 1.25))
        return sol.x_final, sol

    def exact(p):
        kick, rate = p
        return (0.5 + kick + rate - jnp.where(0.5 + rate + kick > 1, rate, -rate))[None]

    sols = assert_derivatives(end, exact, [[0.7, 0.2], [0.05, 0.2]], 64, order=1)
    assert_array_equal(sols.num_events, [2, 1])
    # A section that the kick carries it across is crossed then, and again on the way back.
    assert_array_equal(sols.num_crossings, [2, 0])
    assert_within(sols.crossings.ts[0, :2], [1.0, 1.75], 64 * EPS)


@pytest.mark.slow
@pytest.mark.parametrize("system", [Sided, SidedByTick])
def test_what_is_carried_across_a_surface_is_told_from_a_crossing(system):
    run = jax.jit(jax.vmap(lambda p: solve(system(*p), [0.5], 2.0)))
    first = TICK if system is SidedByTick else IMPACT
    assert kinds_of(run(jnp.array([[0.7, 0.2], [0.05, 0.2]]))) == [[first, CARRY], [first]]


class Spike(jf.System):
    """x' = 0; ticks at 1, 2, … kick it; at 15 it is set back to 0, and counted."""

    kick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return 0 * x

    def switching(self, t, x):
        return 15 - x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0] - 15, x[1] + 1])

    def tick(self, t, x, clock):
        return jnp.stack([x[0] + self.kick, x[1]])

    @property
    def clocks(self):
        return (jf.Clock(1.0),)


@pytest.mark.release
def test_a_tick_fires_what_it_kicks_past_its_threshold():
    def end(p):
        sol = solve(Spike(p[0]), [0.0, 0.0], 2.5)
        return sol.x_final, sol

    def exact(p):
        (kick,) = p
        count = jnp.where(kick > 15, 2, jnp.where(kick > 7.5, 1, 0))
        return jnp.stack([2 * kick - 15 * count, count + 0 * kick])

    sols = assert_derivatives(end, exact, [[6.0], [14.0], [16.0]], 64)
    assert kinds_of(sols) == [[TICK] * 2, [TICK, TICK, IMPACT], [TICK, IMPACT] * 2]


class Gate(jf.System):
    """At a the gate opens, at b the state grows by 1 if it is open; either is the first surface."""

    a: jax.Array
    b: jax.Array
    opening: int = eqx.field(static=True)

    def vector_field(self, t, x, side):
        return 0 * x

    def switching(self, t, x):
        return jnp.stack([t - self.a, t - self.b][:: 1 - 2 * self.opening])

    def reset(self, t, x, surface):
        opened = jnp.stack([x[0], 1 + 0 * x[1]])
        return jnp.where(surface == self.opening, opened, jnp.stack([x[0] + x[1], x[1]]))


@pytest.mark.slow
@pytest.mark.parametrize("opening", [pytest.param(0, marks=pytest.mark.release), 1])
def test_a_reset_sees_what_the_one_before_it_has_left(opening):
    """At one time the lowest number comes first; at times that differ, the earlier one."""
    run = jax.jit(jax.vmap(lambda a, b: solve(Gate(a, b, opening), [0.0, 0.0], 2.0)))
    times = np.array([[1, 1.05], [1, 1], [1, 1 + 2e-16], [0.97, 0.97], [1.05, 1.0]])
    sols = run(*jnp.asarray(times.T))
    passes = [1.0] + [1.0 - opening] * 3 + [0.0]
    assert_array_equal(sols.x_final, [[v, 1.0] for v in passes])
    assert (sols.result == jf.RESULTS.successful).all()
    assert_array_equal(sols.num_events, 2)


class Jump(jf.System):
    """x' = −x; at 1 it is kicked, and at 15 set to 0."""

    kick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return -x

    def switching(self, t, x):
        return jnp.stack([15 - x[0], t - 1])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, 0 * x, x + self.kick)


@pytest.mark.release
def test_a_kick_over_a_threshold_of_a_lower_number():
    options = dict(stepper=diffrax.Dopri8())
    run = jax.jit(jax.vmap(lambda w: solve(Jump(w), [0.0], 1.6, **options)))
    sols = run(jnp.array([14.0, 16.0, 20.0]))
    assert (sols.result == jf.RESULTS.successful).all()
    assert_within(sols.x_final[:, 0], [14 * np.exp(-0.6), 0, 0], 64 * EPS * 14)
    assert kinds_of(sols) == [[IMPACT], [IMPACT] * 2, [IMPACT] * 2]


def struck(kicks, weights):
    """Three neurons that stand still; at t = 1 all are kicked, and one that fires kicks another."""
    still = jnp.zeros(3)
    return clocked_problems.Neurons(still, still, weights, jnp.array(10.0), jnp.array(1.0), kicks)


@pytest.mark.release
def test_a_neuron_that_is_pulled_back_below_its_threshold_does_not_fire():
    """Neuron 0 pulls neuron 1 back, while neuron 2 has still to fire."""
    run = jax.jit(
        jax.vmap(lambda w: solve(struck(jnp.array([0.5, 0.3, 0.7]), w), [0.9, 0.8, 0.4], 1.5))
    )
    pull = jnp.zeros((3, 3, 3)).at[:, 0, 1].set(jnp.array([-0.4, -0.05, -0.4]))
    # In the last lane neuron 2 pushes it over its threshold once more.
    sols = run(pull.at[2, 2, 1].set(0.6))
    assert (sols.result == jf.RESULTS.successful).all()
    counts = [2, 3, 3]
    assert_array_equal(sols.num_events, np.add(counts, 1))
    fired = [row[1 : k + 1].tolist() for row, k in zip(sols.events.surfaces, counts, strict=True)]
    assert fired == [[0, 2], [0, 1, 2], [0, 2, 1]]
    assert_within(sols.x_final, [[0, 0.7, 0], [0, 0, 0], [0, 0, 0]], 8 * EPS)


@pytest.mark.slow
def test_a_run_goes_on_from_an_avalanche():
    """What has happened at its end is not done again."""
    system = Neurons(jnp.array([1.0, 0.05]), jnp.array(0.2))
    first = solve(system, [0.0, 0.9], 1.0)
    assert surfaces_of(first) == [0, 1]
    last = solve(system, first.x_final, 1.5, t0=1.0)
    assert table(last)[1] == []
    assert_within(last.x_final, [0.7, 0.025], 64 * EPS)


class Pair(jf.System):
    """Two neurons with rates 1 and 1/4 that kick each other."""

    kick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([1.0 + 0 * t, 0.25 + 0 * t])

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        return jnp.where(jnp.arange(2, dtype=jnp.int32) == surface, 0.0, x + self.kick)


@pytest.mark.slow
def test_a_kick_to_the_threshold_itself_fires():
    """From 1/2, at t = 1 the second neuron is at 3/4, and the kick brings it to 1."""
    kicks = 0.25 + np.array([-1e-9, 0.0, 1e-9])
    sols = jax.vmap(lambda kick: solve(Pair(kick), (0.0, 0.5), 1.5, dt=0.125))(kicks)
    assert_array_equal(jf.RESULTS.names(sols.result), "successful")
    assert_within(sols.x_final, np.array([[0.75, 0.125]] * 3), 1e-8)
    assert_within(sols.x_final[1], np.array([0.75, 0.125]), 16 * EPS)


class Leaky(jf.System):
    """v' = 3/2 − v, which fires at 1; `s` is the sign of H."""

    s: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return 1.5 - x

    def switching(self, t, x):
        return self.s * (1 - x[0])

    def reset(self, t, x, surface):
        return 0 * x


def test_a_start_on_the_threshold_fires_whatever_the_sign_of_h():
    """The reset leads off the surface, so it is not one of a wall."""
    starts, signs = np.array([1 - 1e-12, 1.0] * 2), np.array([1.0, 1.0, -1.0, -1.0])
    run = lambda v, s: solve(Leaky(s), (v,), 0.5, dt=0.01, stepper=diffrax.Dopri8())  # noqa: E731
    sols = jax.vmap(run)(starts, signs)
    assert_within(sols.x_final[:, 0], np.full(4, 1.5 * (1 - np.exp(-0.5))), 1e-11)
    assert_array_equal(sols.num_events, 1)


@pytest.mark.parametrize("max_events", [64, 1024])
@pytest.mark.slow
def test_an_endless_avalanche_is_zeno_in_a_table_of_any_size(max_events):
    sol = solve(Pair(jnp.asarray(1.2)), [0.0, 0.0], 2.0, max_events=max_events)
    assert jf.RESULTS.names(sol.result) == "zeno"
    assert_within(sol.t_final, 1.0, 8 * EPS)


class Pulsed(jf.System):
    """v' = I − v; at v = 1 a neuron is set to 0 and the others are kicked by its weights. A clock
    raises all of them."""

    weights: jax.Array
    drive: jax.Array
    slides: ClassVar[bool] = False
    clocks: ClassVar[tuple] = (jf.Clock(0.9, 0.37),)

    def vector_field(self, t, x, side):
        return self.drive - x

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        number = jnp.arange(x.shape[0], dtype=jnp.int32)
        return jnp.where(number == surface, 0.0, x + self.weights[surface])

    def tick(self, t, x, clock):
        return x + 0.11


def fired(weights, drive, v, end):
    """The voltages of `Pulsed` at the end, by logarithms."""
    v, t, ticks = v.copy(), 0.0, 0
    while True:
        waits = np.log((drive - v) / (drive - 1))
        wait = min(waits.min(), 0.37 + 0.9 * ticks - t, end - t)
        v, t = drive + (v - drive) * np.exp(-wait), t + wait
        if t >= end - 1e-13:
            return v
        if wait == waits.min():
            due = [int(waits.argmin())]
        else:
            v, ticks = v + 0.11, ticks + 1
            due = list(np.flatnonzero(v > 1))
        while due:
            v = np.where(np.arange(v.size) == due[0], 0.0, v + weights[due[0]])
            due = list(np.flatnonzero(v > 1))


@pytest.mark.slow
@pytest.mark.parametrize("n", [pytest.param(3, marks=pytest.mark.release), 4])
def test_a_network_is_run_backward(n):
    """In a loop with checkpoints, where surfaces are numbers and where they are an array."""
    rng = np.random.default_rng(n)
    weights = rng.uniform(0.02, 0.12, (n, n))
    np.fill_diagonal(weights, 0.0)
    drive, v, end = np.linspace(1.25, 1.6, n), rng.uniform(0.1, 0.8, n), 2.0

    def loss(weights):
        run = dict(adjoint=diffrax.RecursiveCheckpointAdjoint(), stepper=diffrax.Tsit5())
        sol = solve(Pulsed(weights, jnp.asarray(drive)), v, end, 0.05, **run)
        return jnp.sum(sol.x_final**2), sol.x_final

    slope, x = jax.grad(loss, has_aux=True)(jnp.asarray(weights))
    np.testing.assert_allclose(x, fired(weights, drive, v, end), rtol=0, atol=1e-6)
    h = 1e-6
    for i, j in ((0, 1), (1, 0), (n - 1, 0)):
        move = np.zeros((n, n))
        move[i, j] = h
        ahead, behind = ((fired(weights + s * move, drive, v, end) ** 2).sum() for s in (1, -1))
        np.testing.assert_allclose(slope[i, j], (ahead - behind) / (2 * h), rtol=0, atol=2e-5)
