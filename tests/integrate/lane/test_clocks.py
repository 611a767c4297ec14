"""Clocks: jumps of a field or of H at known times are met exactly, with their derivatives.

Against closed forms, and for a voltage-mode buck converter against matrix exponentials.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxfil as jf

EPS = np.finfo(float).eps


class Sawtooth(jf.System):
    """x' = t mod T."""

    tooth: jax.Array

    def vector_field(self, t, x, side):
        return jnp.mod(t, self.tooth)[None]

    @property
    def clocks(self):
        return (jf.Clock(self.tooth),)


class Modulator(Sawtooth):
    """x falls at a rate of 1 above the ramp t mod T, and grows at 1/2 below it."""

    slides: ClassVar[bool] = False

    def switching(self, t, x):
        return x[0] - jnp.mod(t, self.tooth)

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, -1.0, 0.5)[None]


def with_slope(system, x0, t1, dt):
    """The end of a run of a system with T = 0.3, its derivative by T, and the run."""

    def end(tooth):
        sol = jf.solve(system(tooth), jnp.array([x0]), 0.0, t1, dt, stepper=jf.RK4())
        return sol.xs[0, 0], sol

    return jax.jacfwd(end, has_aux=True)(jnp.array(0.3))


@pytest.mark.parametrize("dt, steps", [(0.25, 7), (0.1, 10)])
def test_a_field_that_jumps_is_integrated_as_the_pieces_that_it_has(dt, steps):
    """Three teeth of area T²/2, and a part of 1 − 3T; ticks that are no grid points, and ticks that
    are."""
    slope, sol = with_slope(Sawtooth, 0.0, 1.0, dt)
    np.testing.assert_allclose(sol.xs[0, 0], 3 * 0.045 + 0.005, rtol=8 * EPS)
    # Terms that sum to 3; a tick is told from what is before it by 8 eps of its time.
    np.testing.assert_allclose(slope, 3 * 0.3 - 3 * 0.1, rtol=0, atol=3 * 32 * EPS)
    assert sol.num_events == 0 and sol.stats["num_steps"] == steps


@pytest.mark.parametrize("dt", [0.25, 0.1])
def test_a_surface_that_jumps_across_the_state_switches_it_at_the_tick(dt):
    """From x at a tick the ramp is met at x/2, after a time x/2; with the next tick the motion is
    at x/2 + (T − x/2)/2, and above the ramp again."""
    slope, sol = with_slope(Modulator, 0.2, 0.8, dt)
    np.testing.assert_allclose(sol.events.ts[:5], [0.1, 0.3, 0.4, 0.6, 0.7], rtol=8 * EPS)
    np.testing.assert_allclose(sol.xs[0, 0], 0.15, rtol=8 * EPS)
    # x₁ = T/2 + x₀/4, x₂ = T/2 + x₁/4, and x₂/2 + (0.8 − 2T − x₂/2)/2 at the end.
    np.testing.assert_allclose(slope, 0.25 * (0.5 + 0.125) - 1, rtol=64 * EPS)
    assert sol.num_events == 5


# The buck converter of Fossas and Olivar (IEEE Transactions on Circuits and Systems I 43 (1996)
# 13–25) and of di Bernardo et al.: state (v, i), the source connected where the ramp is above
# gain·(v − v_ref).
T, LOW, HIGH = 400e-6, 3.8, 8.2
GAIN, V_REF, R, L, C = 8.4, 11.3, 22.0, 20e-3, 47e-6
MATRIX = np.array([[-1 / (R * C), 1 / C], [-1 / L, 0.0]])


class Buck(jf.System):
    """In units of T, so that steps and rates are of order one."""

    source: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        on = jnp.where(side > 0, 0.0, self.source)
        return T * jnp.stack([-x[0] / (R * C) + x[1] / C, (on - x[0]) / L])

    def switching(self, t, x):
        return GAIN * (x[0] - V_REF) - (LOW + (HIGH - LOW) * jnp.mod(t, 1.0))

    @property
    def period(self):
        return 1.0

    @property
    def clocks(self):
        return (jf.Clock(1.0),)


def exact(x, source, periods):
    """The states at ends of periods, by matrix exponentials and roots of the control voltage."""
    states = []
    for _ in range(periods):
        t = 0.0
        while t < 1:

            def ahead(s, t=t, x=x, on=None):
                on = gap(t, x) < 0 if on is None else on
                rest = np.linalg.solve(MATRIX, [0.0, -source / L]) * on
                return expm(MATRIX * T * (s - t)) @ (x - rest) + rest

            side = gap(t + 1e-12, ahead(t + 1e-12)) < 0
            path = lambda s, side=side: gap(s, ahead(s, on=side))  # noqa: E731
            grid = np.linspace(t + 1e-9, 1, 41)
            values = np.array([path(s) for s in grid])
            turns = np.flatnonzero((values < 0) != side)
            if not turns.size:
                x, t = ahead(1.0, on=side), 1.0
                break
            s = brentq(path, grid[turns[0] - 1], grid[turns[0]], xtol=1e-15, rtol=4 * EPS)
            x, t = ahead(s, on=side), s
        states.append(x)
    return np.array(states)


def gap(s, x):
    return GAIN * (x[0] - V_REF) - (LOW + (HIGH - LOW) * s)


@pytest.fixture(scope="module")
def diagram():
    """Settled, or not, at five voltages of the source: orbits of period one and two before and
    after the doubling near 24.5 V, four, and chaos above 32.3 V."""
    return jf.bifurcation_diagram(
        Buck(jnp.array(20.0)),
        "source",
        jnp.array([24.0, 25.0, 31.5, 33.0]),
        jnp.array([12.0, 0.55]),
        transient=300,
        samples=64,
        steps=16,
        stepper=jf.RK4(),
        compact=True,
        progress=False,
    )


def test_a_buck_converter_doubles_its_period_and_comes_to_large_chaos(diagram):
    assert diagram.successful.all()
    assert diagram.periods()[:3].tolist() == [1, 2, 4]
    assert diagram.periods()[3] == 0
    spread = np.ptp(diagram.xs[..., 0], axis=-1)
    assert spread[3] > 3 * spread[2], "chaos is large at once"


def test_a_buck_converter_moves_as_its_matrix_exponentials_say(diagram):
    """Its orbits of period one and two are those of the maps over whole ramps."""
    for row, period in ((0, 1), (1, 2)):
        x, source = diagram.xs[row, -1], float(diagram.values[row])
        np.testing.assert_allclose(exact(x, source, period)[-1], x, rtol=1e-7)


class Pulse(jf.System):
    """x' = 1 in the first half of each period of a clock with a phase, else 0, or the ramp since
    its tick."""

    tooth: jax.Array
    phase: jax.Array
    ramp: bool = eqx.field(static=True)

    def vector_field(self, t, x, side):
        since = jnp.mod(t - self.phase, self.tooth)
        return since[None] if self.ramp else jnp.where(since < 0.5 * self.tooth, 1.0, 0.0)[None]

    @property
    def clocks(self):
        second = jf.Clock(self.tooth, self.phase + 0.5 * self.tooth)
        first = jf.Clock(self.tooth, self.phase)
        return (first,) if self.ramp else (first, second)


@pytest.mark.slow
@pytest.mark.parametrize("ramp", [False, True])
def test_ticks_have_the_rounding_of_their_phases(ramp):
    """Phases much larger than the time: what a field makes of t − φ is rounded as φ is."""

    def integral(t, tooth, phase):
        count = np.floor((t - phase) / tooth)
        rest = (t - phase) - count * tooth
        if ramp:
            return count * tooth**2 / 2 + rest**2 / 2
        return count * tooth / 2 + np.minimum(rest, tooth / 2)

    draw, n = np.random.default_rng(0), 400
    tooth, start = draw.uniform(0.1, 0.6, n), draw.uniform(0, 5, n) * (np.arange(n) % 2)
    phase = draw.uniform(-1, 1, n) * 10.0 ** draw.integers(0, 4, n)

    @jax.jit
    @jax.vmap
    def end(tooth, phase, start):
        x0 = jnp.zeros(1)
        sol = jf.solve(Pulse(tooth, phase, ramp), x0, start, start + 1.0, 0.05, throw=False)
        return sol.result, sol.x_final[0]

    results, ends = end(*map(jnp.asarray, (tooth, phase, start)))
    assert (results == jf.RESULTS.successful).all()
    exact = integral(start + 1.0, tooth, phase) - integral(start, tooth, phase)
    # Some twenty pieces, whose ends are known to the rounding of their phases.
    assert (abs(ends - exact) <= 64 * EPS * (1 + abs(phase))).all()


class Samples(jf.System):
    """The sum of the numbers of the ticks of the first clock, and the ticks of the second one."""

    clocks = (jf.Clock(1.0), jf.Clock(2.0))

    def vector_field(self, t, x, side):
        return 0 * x

    def tick(self, t, x, clock):
        return jnp.where(clock == 0, x.at[0].add(jnp.floor(t)), x.at[1].add(1.0))


class SamplesWithSurface(Samples):
    def switching(self, t, x):
        return x[0] + 100


class Stairs(jf.System):
    """A threshold that rises with each tick, in front of a state that is kicked by as much; resets
    are counted."""

    clocks = (jf.Clock(1.0), jf.Clock(2.0))
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return 0 * x

    def switching(self, t, x):
        return 1 + jnp.floor(t) - x[0]

    def reset(self, t, x, surface):
        return x.at[1].add(1.0)

    def tick(self, t, x, clock):
        return jnp.where(clock == 0, x.at[0].add(1.0), x)


@pytest.mark.parametrize(
    "system, start, end",
    [
        (Samples(), (0.0, 0.0), (10.0, 2.0)),
        (SamplesWithSurface(), (0.0, 0.0), (10.0, 2.0)),
        (Stairs(), (0.5, 0.0), (4.5, 0.0)),
    ],
    ids=["alone", "surface", "stairs"],
)
@pytest.mark.slow
def test_ticks_at_one_time_are_all_seen_from_just_after_it(system, start, end):
    sol = jf.solve(system, jnp.array(start), 0.0, 4.5, 0.1, compact=True, throw=False)
    assert jf.RESULTS.names(sol.result) == "successful"
    np.testing.assert_array_equal(sol.x_final, end)


class Dose(jf.System):
    """x' = −x, with a dose at each tick and a kick at the time s."""

    dose: jax.Array
    phase: jax.Array
    s: jax.Array
    kick: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return -x

    def switching(self, t, x):
        return t - self.s

    def reset(self, t, x, surface):
        return x + self.kick

    def tick(self, t, x, clock):
        return x + self.dose

    @property
    def clocks(self):
        return (jf.Clock(0.1, self.phase),)


@jax.jit
@jax.vmap
def doses(p, x0, t0, ts):
    """The states saved at `ts`, the derivative of the last one by p, and the outcome."""

    def states(p):
        options = dict(saveat=diffrax.SaveAt(ts=ts), stepper=jf.RK4(), throw=False)
        sol = jf.solve(Dose(*p), x0[None], t0, ts[-1], 0.0125, **options)
        return sol.xs[-1, 0], (sol.xs[:, 0], sol.result)

    slope, (xs, result) = jax.jacfwd(states, has_aux=True)(p)
    return xs, slope, result


def test_every_tick_of_a_large_phase_acts_once_in_runs_chained_at_ticks():
    """φ + kT is rounded by more than the times of the run, and by more than those of the kick."""
    phases = np.array([0.0, -100.1, 500.0, -1000.1])
    p = np.array([[0.3, phase, 0.3, 0.7] for phase in phases])
    x, t, saved = np.ones(4), 0.0, []
    for ts in ([0.1, 0.2], [0.3, 0.4], [0.5, 0.55]):
        xs, slope, results = doses(p, x, np.full(4, t), np.tile(ts, (4, 1)))
        assert (results == jf.RESULTS.successful).all()
        x, t = xs[:, -1], ts[-1]
        saved.append(xs)
    whole, slope, results = doses(p, np.ones(4), np.zeros(4), np.tile([0.3, 0.55], (4, 1)))
    assert (results == jf.RESULTS.successful).all()
    times = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.55])

    def exact(t):
        ticks = np.arange(1, round(t / 0.1 - 0.3) + 1) * 0.1
        return np.exp(-t) + 0.3 * np.exp(ticks - t).sum() + 0.7 * np.exp(0.3 - t) * (t > 0.29)

    want, atol = np.array([exact(t) for t in times]), 1e-7
    np.testing.assert_allclose(np.concatenate(saved, axis=1), np.tile(want, (4, 1)), atol=atol)
    np.testing.assert_allclose(whole, np.tile(want[[2, 5]], (4, 1)), atol=atol)
    ticks = np.exp(np.arange(1, 6) * 0.1 - 0.55).sum()
    last = np.exp(0.3 - 0.55)
    by = [ticks, 0.3 * ticks, 0.7 * last, last]
    np.testing.assert_allclose(slope, np.tile(by, (4, 1)), atol=atol)


class Table(jf.System):
    """A ball that rests on a table A sin t, whose ticks are counted; the second clock only has a
    large phase."""

    phase: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -9.81 + 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0] - 0.5 * jnp.sin(t)

    def reset(self, t, x, surface):
        v = 0.5 * jnp.cos(t)
        return x.at[1].set(v - 0.5 * (x[1] - v))

    def tick(self, t, x, clock):
        return jnp.where(clock == 0, x.at[2].add(1.0), x)

    @property
    def clocks(self):
        return jf.Clock(0.5), jf.Clock(1000.0, self.phase)


class Belt(Table):
    """A mass that sticks to a belt of the velocity A sin t."""

    slides: ClassVar[bool] = True
    reset = jf.System.reset

    def vector_field(self, t, x, side):
        return jnp.stack([-2.0 * side, 0 * t, 0 * t])


@pytest.mark.parametrize("system", [Table, Belt])
@pytest.mark.slow
def test_ticks_of_a_large_phase_let_a_state_stay_on_its_surface(system):
    """The ticks are the only events."""

    @jax.vmap
    def end(phase):
        x0 = jnp.array([0.0, 0.5 * (system is Table), 0.0])
        options = dict(stepper=jf.RK4(), compact=True, max_events=16, throw=False)
        sol = jf.solve(system(phase), x0, 0.0, 3.2, 0.1, **options)
        return sol.x_final, sol.num_events, sol.result

    xs, counts, results = end(jnp.array([5.0, 500.0, -123.4]))
    assert (results == jf.RESULTS.successful).all()
    np.testing.assert_allclose(xs[:, 0], 0.5 * np.sin(3.2), rtol=0, atol=1e-11)
    assert xs[:, 2].tolist() == [6.0] * 3
    assert counts.tolist() == [6] * 3
