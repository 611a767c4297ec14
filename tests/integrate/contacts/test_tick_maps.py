"""Maps at known times, of ticks and of resets: what they do, and their derivatives.

A kick, a dose, a latch, a controller that samples and holds. A map that happens to leave the
numbers as they are, a kick of zero, still has its derivative: multipliers, exponents and fits need
it. Against closed forms, and against the matrices of the sampled system (K. J. Åström and B.
Wittenmark, Computer-Controlled Systems, Prentice Hall 1997, chapter 2).
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil import EventKind
from tests.results import assert_derivatives, assert_within, by_imaginary_part, kinds_of

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=jf.RK4(), compact=True, max_events=16, throw=False)


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    x0 = jnp.stack([jnp.asarray(v, float) for v in x0])
    return jf.solve(system, x0, t0, t1, dt, **(OPTIONS | options))


class Kick(jf.System):
    """x'' = −x until a tick at s, at which the velocity jumps by a kick."""

    kick: jax.Array
    s: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0]])

    def tick(self, t, x, clock):
        return jnp.stack([x[0], x[1] + self.kick])

    @property
    def clocks(self):
        return (jf.Clock(10.0, self.s),)


class KickAtSurface(Kick):
    """The same by the reset of a surface in time."""

    slides: ClassVar[bool] = False

    def switching(self, t, x):
        return t - self.s

    def reset(self, t, x, surface):
        return jnp.stack([x[0], x[1] + self.kick])

    ticks: ClassVar[bool] = False
    clocks: ClassVar[tuple] = ()


KICKS = [[0.5, 1.0], [1e-12, 1.05], [0.0, 1.0], [0.0, 0.85]]


@pytest.mark.slow
@pytest.mark.parametrize("system", [Kick, KickAtSurface])
def test_a_kick_of_zero_has_the_derivatives_of_any_other(system):
    """At s = 1 the tick is a grid point, too."""

    def end(p):
        sol = solve(system(*p), [1.0, 0.0], 2.0, 0.05, stepper=diffrax.Dopri8())
        return sol.x_final, sol

    def exact(p):
        kick, s = p
        sine, cosine = jnp.sin(2 - s), jnp.cos(2 - s)
        return jnp.stack([jnp.cos(2.0) + kick * sine, -jnp.sin(2.0) + kick * cosine])

    assert_derivatives(end, exact, KICKS, 128)


@pytest.mark.slow
def test_the_loop_is_run_backward_through_a_kick_of_zero():
    def end(p):
        adjoint = diffrax.RecursiveCheckpointAdjoint()
        options = dict(adjoint=adjoint, stepper=diffrax.Dopri8())
        return solve(Kick(*p), [1.0, 0.0], 2.0, 0.05, **options).x_final[0]

    assert_within(jax.grad(end)(jnp.array([0.0, 1.0])), [np.sin(1), 0.0], 128 * EPS)


class Pull(jf.System):
    """x' = v, v' = 0; at t = 1 the map x ↦ a x, and v ↦ b v."""

    a: jax.Array
    b: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 0 * x[1]])

    def switching(self, t, x):
        return t - 1

    def reset(self, t, x, surface):
        return jnp.stack([1 + self.a * (x[0] - 1), self.b * x[1]])


@pytest.mark.slow
def test_a_map_at_its_fixed_point_has_its_derivative():
    """x ↦ x/4 + 3/4 at 1, and a velocity of zero multiplied by −3."""

    def end(p):
        sol = solve(Pull(p[0], p[1]), p[2:], 2.0)
        return sol.x_final, sol

    def exact(p):
        a, b, x, v = p
        return jnp.stack([1 + a * (x + v - 1) + b * v, b * v])

    lanes = [[0.25, -3.0, 1.0, 0.0], [1.0, -3.0, 0.3, 0.0], [0.25, -3.0, 0.4, 0.1]]
    assert_derivatives(end, exact, lanes, 64, order=1)


class Held(jf.System):
    """x'' = u, where u is sampled at the ticks: u = k (r − x) − d x'."""

    k: jax.Array
    d: jax.Array
    r: jax.Array
    T: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], x[2], 0 * x[2]])

    def tick(self, t, x, clock):
        return jnp.stack([x[0], x[1], self.k * (self.r - x[0]) - self.d * x[1]])

    @property
    def clocks(self):
        return (jf.Clock(self.T),)

    @property
    def period(self):
        return self.T


class HeldBySurfaces(Held):
    """The same by a reset at the zeros of a sine."""

    slides: ClassVar[bool] = False
    ticks: ClassVar[bool] = False
    clocks: ClassVar[tuple] = ()

    def switching(self, t, x):
        return jnp.sin(jnp.pi * t / self.T)

    def reset(self, t, x, surface):
        return Held.tick(self, t, x, surface)


def held_exact(p):
    """Ticks at T, 2T, 3T of a run from 0 with u = 0 to 3.5 T or so."""
    k, d, r, T, x, v, t1 = p
    u, t = 0 * x, 0 * x
    for h in (T, T, T, t1 - 3 * T):
        x, v = x + h * v + h**2 * u / 2, v + h * u
        u, t = k * (r - x) - d * v, t + h
    # The last sample is not taken.
    return jnp.stack([x, v])


def test_a_controller_that_samples_and_holds_has_its_derivatives():
    """By gains, set point and period, at rest at its set point too."""

    def end(p):
        k, d, r, T, x, v, t1 = p
        x0 = jnp.stack([x, v, 0 * x])
        sol = jf.solve(Held(k, d, r, T), x0, 0 * T, t1, 0.1, **OPTIONS)
        return sol.x_final[:2], sol

    lanes = [[4, 2.5, 0.2, 0.3, 0.1, 0.4, 1.0], [4, 2.5, 0.2, 0.3, 0.2, 0.0, 1.0]]
    assert_derivatives(end, held_exact, lanes, 256)


@pytest.mark.slow
@pytest.mark.parametrize("system", [Held, HeldBySurfaces])
def test_its_orbit_at_rest_has_the_multipliers_of_the_sampled_system(system):
    T, k, d = 0.3, 4.0, 2.5
    closed = np.array([[1, T], [0, 1]]) - np.outer([T * T / 2, T], [k, d])
    held = system(*map(jnp.asarray, (k, d, 0.2, T)))
    x0 = jnp.array([0.2, 0.0, 0.0])
    orbit = jf.periodic_orbit(held, x0, t0=0.15, stepper=jf.RK4(), steps=8, throw=False)
    assert orbit.result == jf.RESULTS.successful
    want = by_imaginary_part([*np.linalg.eigvals(closed), 0])
    # A triple of eigenvalues well apart.
    assert_within(by_imaginary_part(np.asarray(orbit.multipliers)).real, want.real, 256 * EPS)
    assert_within(by_imaginary_part(np.asarray(orbit.multipliers)).imag, want.imag, 256 * EPS)


class Dose(jf.System):
    """x' = −k x, and a dose at each tick."""

    dose: jax.Array
    k: jax.Array
    T: jax.Array

    def vector_field(self, t, x, side):
        return -self.k * x

    def tick(self, t, x, clock):
        return x + self.dose

    @property
    def clocks(self):
        return (jf.Clock(self.T),)


def test_a_dose_adds_what_is_left_of_each():
    """Also with a dose of zero."""

    def end(p):
        sol = solve(Dose(*p), [1.0], 2.5, 0.05, stepper=diffrax.Dopri8())
        return sol.x_final, sol

    def exact(p):
        dose, k, T = p
        left = [jnp.exp(-k * (2.5 - n * T)) for n in range(1, 4)]
        return (jnp.exp(-k * 2.5) + dose * sum(left))[None]

    assert_derivatives(end, exact, [[2.0, 0.5, 0.8], [0.0, 0.5, 0.75]], 256)


def test_a_dose_is_fitted_from_the_guess_zero():
    ts = jnp.linspace(0.5, 1.9, 6)
    data = jnp.exp(-0.5 * ts) + jnp.where(ts > 1, 2 * jnp.exp(-0.5 * (ts - 1)), 0.0)
    system = Dose(*map(jnp.asarray, (0.0, 0.5, 1.0)))
    fit = jf.fit(
        system,
        ("dose",),
        ts,
        data,
        jnp.ones(1),
        0.1,
        observe=lambda t, x: x[0],
        guesses=jnp.zeros((1, 1)),
        throw=False,
    )
    assert fit.result == jf.RESULTS.successful
    assert_within(fit.values, [2.0], 1e-6)


class Latch(jf.System):
    """A ramp that a latch turns round: at the first tick behind a level, by the second clock."""

    level: jax.Array
    T: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.where(x[1] > 0, -1.0, 1.0), 0 * x[1]])

    def tick(self, t, x, clock):
        latched = jnp.maximum(x[1], jnp.where(x[0] > self.level, 1.0, 0.0))
        return jnp.stack([x[0], jnp.where(clock == 1, latched, x[1])])

    @property
    def clocks(self):
        return jf.Clock(self.T), jf.Clock(3 * self.T, self.T)


def test_a_latch_is_set_by_its_own_clock():
    """At 0.31 and 1.24, behind the level at the second of them; and at once where they are one."""

    def end(p):
        sol = solve(Latch(*p), [0.0, 0.0], 2.0)
        return sol.x_final, sol

    def exact(p):
        level, T = p
        turn = jnp.where(level < T, T, 4 * T)
        return jnp.stack([2 * turn - 2, 1 + 0 * T])

    assert_derivatives(end, exact, [[0.5, 0.31], [0.2, 0.3], [1.1, 0.4]], 64)


class Ramp(jf.System):
    """x'' = 1 − k x' until the tick at s, and −k x' after it."""

    s: jax.Array
    k: jax.Array

    def vector_field(self, t, x, side):
        push = jnp.where(jnp.floor((t - self.s) / 10.0) < 0, 1.0, 0.0)
        return jnp.stack([x[1], push - self.k * x[1]])

    @property
    def clocks(self):
        return (jf.Clock(10.0, self.s),)


class RampWithSurface(Ramp):
    """The same with a surface far away."""

    def switching(self, t, x):
        return x[0] + 5


@pytest.mark.parametrize("system", [Ramp, RampWithSurface])
def test_a_tick_on_a_grid_point_has_its_derivative(system):
    """By its phase, where the field does not commute with itself."""

    def end(p):
        s, k = p
        sol = solve(system(s, k), [0.0, 0.0], 3.0, 0.125, stepper=diffrax.Dopri8())
        return sol.x_final, sol

    def exact(p):
        s, k = p
        v = (1 - jnp.exp(-k * s)) / k
        left = jnp.exp(-k * (3 - s))
        return jnp.stack([(s - v) / k + v * (1 - left) / k, v * left])

    lanes = [[1.0, 1.0], [1.1, 1.0], [2.5, 0.8], [1 + 1e-15, 1.0], [1 + 1e-12, 1.0]]
    assert_derivatives(end, exact, lanes, 512, order=1)


class Sampler(jf.System):
    """A relay whose threshold is sampled: the tick moves the surface, and then the state."""

    T: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([-0.5 * side, 0 * x[1]])

    def switching(self, t, x):
        return x[0] - x[1]

    def tick(self, t, x, clock):
        return jnp.stack([x[0], x[1] + 1])

    @property
    def clocks(self):
        return (jf.Clock(self.T),)


def test_a_tick_is_an_event_and_so_is_what_follows_from_it():
    """A slide at the threshold 0; at the tick it is 1, the slide ends, and is met after 2."""

    def end(p):
        sol = solve(Sampler(*p), [0.5, 0.0], 4.2)
        return jnp.concatenate([sol.x_final, sol.events.ts[:3]]), sol

    def exact(p):
        (T,) = p
        return jnp.stack([(4.2 - T) / 2, 1 + 0 * T, 1 + 0 * T, T, T])

    sols = assert_derivatives(end, exact, [[2.5], [2.6]], 64, order=1)
    assert kinds_of(sols) == [[EventKind.stick, EventKind.tick, EventKind.slip]] * 2


class Kicked(jf.System):
    """x' = −10 x, with a kick by 1 at each whole time."""

    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return -10 * x

    def tick(self, t, x, clock):
        return x + 1


def test_sections_see_a_kick_without_surfaces():
    level = jf.Section(lambda t, x: x[0] - 0.5)
    sol = jf.solve(Kicked(), jnp.zeros(1), 0.0, 2.5, 0.02, sections=level, max_events=8)
    # It jumps to 1, falls through 1/2 after log(2)/10, and jumps to 1 + exp(−10) in its turn.
    times = [1, 1 + np.log(2) / 10, 2, 2 + np.log(2 * (1 + np.exp(-10))) / 10]
    np.testing.assert_allclose(sol.crossings.ts[:4], times, rtol=1e-9)
    np.testing.assert_allclose(sol.crossings.xs[:4, 0], [1, 0.5, 1 + np.exp(-10), 0.5], rtol=1e-9)
    assert not np.isfinite(sol.crossings.ts[4:]).any()


def test_backward_in_time_a_kick_cannot_be_undone_without_surfaces_either():
    back = jf.solve(Kicked(), jnp.ones(1), 2.5, 0.0, 0.05, throw=False)
    assert jf.RESULTS.names(back.result) == "irreversible_reset" and float(back.t_final) == 2.0


class Alternating(jf.System):
    """A clock changes the direction of motion."""

    size: jax.Array
    period: ClassVar[float] = 2.0
    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return self.size * (1 - 2 * jnp.mod(jnp.floor(t), 2)) + 0 * x


def test_a_maximum_at_a_jump_of_the_field_is_that_of_the_motion():
    found = jf.bifurcation_diagram(
        Alternating(jnp.asarray(1.0)),
        "size",
        np.array([1.0, 2.0]),
        np.zeros(1),
        transient=1,
        samples=2,
        steps=8,
        average=jf.Maximum(lambda t, x, side: x[0]),
        progress=False,
    )
    np.testing.assert_allclose(found.averages["average"], [1, 2], rtol=1e-14)


class Limited(jf.System):
    """A current that grows at 1 while its switch is on and falls at 1/2 while it is off: on at each
    tick, off at the limit."""

    limit: jax.Array
    slides: ClassVar[bool] = False
    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.where(x[1] > 0.5, 1.0, -0.5), 0 * x[1]])

    def switching(self, t, x):
        return self.limit - x[0]

    def reset(self, t, x, surface):
        return x.at[1].set(0.0)

    def tick(self, t, x, clock):
        return x.at[1].set(1.0)


def test_a_limit_that_is_reached_at_a_tick_is_still_a_limit():
    """Switched off, on and off again at t = 1; at 1/2 at t = 2, at 3/4 at 3, and at 5/8 at 4."""
    limits, x0 = 1.0 + np.array([-1e-9, 0.0, 1e-9]), (0.0, 1.0)
    sols = jax.vmap(lambda limit: solve(Limited(limit), x0, 4.0))(limits)
    assert jf.RESULTS.names(sols.result).tolist() == ["successful"] * 3
    np.testing.assert_allclose(sols.x_final, [[0.625, 1.0]] * 3, rtol=0, atol=1e-8)
    np.testing.assert_allclose(sols.x_final[1], [0.625, 1.0], rtol=0, atol=16 * EPS)


class Counter(jf.System):
    """Ticks counted."""

    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return 0 * x

    def tick(self, t, x, clock):
        return x + 1


class CounterWithSurface(Counter):
    def switching(self, t, x):
        return x[0] + 100


@pytest.mark.parametrize("system", [Counter(), CounterWithSurface()], ids=["alone", "surface"])
def test_a_tick_at_the_start_of_a_run_backward_is_undone_first(system):
    """The state at t0 is the one after the tick."""
    sol = solve(system, (6.0,), 1.5, t0=2.0)
    assert jf.RESULTS.names(sol.result) == "irreversible_reset"
    sol = solve(system, (6.0,), 2.0, t0=2.5)
    assert jf.RESULTS.names(sol.result) == "successful" and float(sol.x_final[0]) == 6


class Tank(jf.System):
    """An inlet that closes when the level comes to 1; a tick at t = 3 opens the outlet."""

    slides: ClassVar[bool] = False
    clocks: ClassVar = (jf.Clock(10.0, 3.0),)

    def vector_field(self, t, x, side):
        filling, draining = x[1] > 0.5, x[1] < -0.25
        flow = jnp.where(filling, 1.0, jnp.where(draining, -0.5, 0.0))
        return jnp.stack([flow, 0 * x[1]])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        return x.at[1].set(0.0)

    def tick(self, t, x, clock):
        return x.at[1].set(-0.5)


@pytest.mark.parametrize("x0, t0", [((0.0, 1.0), 0.0), ((1.0, 0.0), 1.0), ((1.0, 1.0), 1.0)])
def test_a_level_that_stands_at_its_surface_stays_there(x0, t0):
    sol = solve(Tank(), x0, 4.0, t0=t0)
    assert jf.RESULTS.names(sol.result) == "successful"
    np.testing.assert_allclose(sol.x_final, [0.5, -0.5], rtol=0, atol=16 * EPS)


class Counted(jf.System):
    """A block on friction 1 that stops at t = 1/2 and sticks; its stops are counted, and a clock
    ticks without an effect."""

    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return jnp.stack([-side, 0 * x[1]])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[1].add(1.0)


def test_a_tick_is_no_contact_of_a_surface_on_which_the_motion_slides():
    sol = solve(Counted(), (0.5, 0.0), 3.5)
    assert jf.RESULTS.names(sol.result) == "successful"
    np.testing.assert_allclose(sol.x_final, [0.0, 1.0], rtol=0, atol=16 * EPS)


class Raised(jf.System):
    """A number that a tick raises by one."""

    clocks: ClassVar = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return 0 * x

    def tick(self, t, x, clock):
        return x + 1


def test_a_section_is_seen_from_one_side_of_a_tick():
    """S = floor(t) − x + 1/2 does not change: both grow by one at each tick."""
    section = jf.bound(lambda t, x: jnp.floor(t) - x[0] + 0.5)
    sol = solve(Raised(), (0.0,), 4.5, sections=section)
    assert jf.RESULTS.names(sol.result) == "successful" and int(sol.num_crossings) == 0


class PhaseLocked(jf.System):
    """A charge-pump phase-locked loop: phase, voltage, up, down. The edges of the reference are
    ticks, those of the oscillator are resets at the phase 1. The first of both starts the pump, the
    other one stops it."""

    f0: jax.Array
    gain: jax.Array
    slides = False
    clocks = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        pump = x[2] - x[3]
        return jnp.stack([self.f0 + self.gain * (x[1] + 0.6 * pump), 0.2 * pump, 0 * t, 0 * t])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        up = x[2] > 0.5
        return jnp.stack([x[0] - 1, x[1], jnp.where(up, 0.0, x[2]), jnp.where(up, x[3], 1.0)])

    def tick(self, t, x, clock):
        down = x[3] > 0.5
        return jnp.stack([x[0], x[1], jnp.where(down, x[2], 1.0), jnp.where(down, 0.0, x[3])])


@pytest.mark.slow
def test_an_edge_at_the_rounded_time_of_a_tick_is_not_lost():
    # Locked, both edges fall together in every period, to rounding, and v = (1 − f0)/gain.
    def end(p):
        start = jnp.array([0.3, 0.0, 0.0, 0.0])
        sol = jf.solve(PhaseLocked(p[0], p[1]), start, 0.0, 120.5, 0.25, max_events=512)
        return sol.x_final[:2], sol.x_final

    slopes, found = jax.jit(jax.jacfwd(end, has_aux=True))(jnp.array([0.8, 1.0]))
    np.testing.assert_allclose(found, [0.5, 0.2, 0, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(slopes, [[0, 0], [-1, -0.2]], rtol=0, atol=1e-6)


class Conveyor(jf.System):
    """A block that sticks on a belt, whose speed a tick sets to a command p, its own at first."""

    command: jax.Array
    clocks: ClassVar[tuple] = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -5.0 * side, 0 * t])

    def switching(self, t, x):
        return x[1] - x[2]

    def tick(self, t, x, clock):
        return x.at[2].set(self.command)


class ConveyorWithTimer(jf.System):
    """The same by a timer in the state and its reset."""

    command: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -5.0 * side[0], 0 * t, 1.0 + 0 * t])

    def switching(self, t, x):
        return jnp.stack([x[1] - x[2], -x[3]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, x.at[2].set(self.command).at[3].set(-1.0), x)


class Lift(jf.System):
    """A ball that rests on a table, whose height a tick sets to a command."""

    command: jax.Array
    slides: ClassVar[bool] = False
    clocks: ClassVar[tuple] = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -9.81 + 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0] - x[2]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)

    def tick(self, t, x, clock):
        return x.at[2].set(self.command)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "x0", "by"),
    [
        (Conveyor, [0.0, 1.0, 1.0], [2.5, 1.0, 1.0]),
        pytest.param(
            *(ConveyorWithTimer, [0.0, 1.0, 1.0, -0.5], [2.5, 1.0, 1.0, 0.0]),
            marks=pytest.mark.release,
        ),
        (Lift, [1.0, 0.0, 1.0], [1.0, 0.0, 1.0]),
    ],
)
def test_a_command_that_a_slide_or_a_rest_obeys_already_has_its_derivative(system, x0, by):
    # Any other command moves the block or the ball at once, but not the belt or the table.
    found = jax.jacfwd(lambda p: solve(system(p), x0, 3.0).x_final)(jnp.array(1.0))
    np.testing.assert_allclose(found, by, rtol=0, atol=64 * EPS)


class Stops(jf.System):
    """A sampled drive between two stops that it does not reach."""

    gain: jax.Array
    clocks: ClassVar[tuple] = (jf.Clock(0.01),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.gain * x[0]])

    def switching(self, t, x):
        return jnp.stack([1 - x[0], 1 + x[0]])

    def reset(self, t, x, surface):
        return -x

    def tick(self, t, x, clock):
        return x.at[1].set(-self.gain * x[0])


@pytest.mark.slow
def test_ticks_without_a_contact_may_be_many():
    sol = solve(Stops(jnp.array(1.0)), [0.5, 0.0], 42.0, max_events=4300)
    assert bool(sol.result == jf.RESULTS.successful) and int(sol.num_events) == 4200


class Counter(jf.System):
    """x' = 0, and each tick adds one."""

    every: jax.Array
    period = 1.0

    def vector_field(self, t, x, side):
        return 0.0 * x

    def tick(self, t, x, clock):
        return x + 1.0

    @property
    def clocks(self):
        return (jf.Clock(self.every, 0.5 * self.every),)


def test_a_sampled_run_may_have_many_more_ticks_than_steps():
    found = jf.settled_average(
        Counter(jnp.asarray(1 / 2048)),
        lambda t, x, side: x[0],
        jnp.zeros(1),
        transient=39,
        samples=1,
        steps=2,
        stepper=jf.RK4(),
    )
    assert found.result == jf.RESULTS.successful
    # The number of ticks k + 1/2 before the time 40, which are powers of two.
    np.testing.assert_array_equal(found.x_final, [40 * 2048])
