"""Friction and contacts that feel each other: weights of slides and reactions of rests are one
variational inequality.

Blocks that push each other on dry friction, redundant friction, stacked blocks that are pulled up,
a mass at the very limit of its friction. Against parabolas, the pair of a linear complementarity
problem of two that holds (R. W. Cottle, J.-S. Pang and R. E. Stone, The Linear Complementarity
Problem, 1992), and event-driven code in SciPy.
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
from tests.results import assert_derivatives, assert_within, kinds_of, outcome_names

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=jf.RK4(), compact=True, max_events=32, throw=False)
STICK, SLIP, IMPACT = EventKind.stick, EventKind.slip, EventKind.impact


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    return jf.solve(system, jnp.asarray(x0), t0, t1, dt, **(OPTIONS | options))


class Push(jf.System):
    """Block 1 on dry friction F = 1, and block 2, without, that the force p + r t pushes against
    it: masses 1, no restitution."""

    p: jax.Array
    r: jax.Array
    friction: ClassVar[int] = 0

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], -side[self.friction], -(self.p + self.r * t)])

    def switching(self, t, x):
        surfaces = [x[2], x[1] - x[0]]
        return jnp.stack(surfaces[::-1] if self.friction else surfaces)

    def reset(self, t, x, surface):
        mean = 0.5 * (x[2] + x[3])
        joined = jnp.stack([x[0], x[1], mean, mean])
        return jnp.where(surface == self.friction, x, joined)


class PushAtFirst(Push):
    """The contact is the first surface."""

    friction = 1


@pytest.mark.release
@pytest.mark.parametrize("system", [Push, pytest.param(PushAtFirst, marks=pytest.mark.release)])
def test_a_block_sticks_until_the_one_that_rests_against_it_pushes_enough(system):
    """From rest in contact; at (1 − p)/r both begin to move."""

    def end(p):
        sol = solve(system(*p), jnp.zeros(4), 5.0, 0.1)
        return jnp.concatenate([sol.x_final, sol.events.ts[:1]]), sol

    def exact(p):
        push, r = p
        slips = (1 - push) / r
        s = 5 - slips
        x, v = -r * s**3 / 12, -r * s**2 / 4
        return jnp.stack([x, x, v, v, slips])

    sols = assert_derivatives(end, exact, [[0.5, 0.2], [0.4, 0.25], [0.6, 0.3]], 1024, order=1)
    assert kinds_of(sols) == [[SLIP]] * 3


@pytest.mark.release
@pytest.mark.parametrize("system", [pytest.param(Push, marks=pytest.mark.release), PushAtFirst])
def test_two_blocks_that_meet_stop_together(system):
    """Thrown together after 1/√p; they move on with half the speed, stop, and stay."""

    def end(p):
        x0 = jnp.stack([0 * p[0], 0.5 + 0 * p[0], 0 * p[0], 0 * p[0]])
        sol = solve(system(p[0], 0 * p[0]), x0, 4.0, 0.05)
        return jnp.concatenate([sol.x_final, sol.events.ts[:3]]), sol

    def exact(p):
        (push,) = p
        meets = jnp.sqrt(1 / push)
        v, a = push * meets / 2, (1 - push) / 2
        x = -(v**2) / (2 * a)
        return jnp.stack([x, x, 0 * x, 0 * x, meets, meets, meets + v / a])

    sols = assert_derivatives(end, exact, [[0.6], [0.5]], 1024, order=1)
    assert kinds_of(sols) == [[IMPACT, SLIP, STICK]] * 2


class Belt(jf.System):
    """A mass pressed against a wall by p, and on a belt of velocity cos t that rubs with f."""

    p: jax.Array
    f: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.p - self.f * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[1] - jnp.cos(t), x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, jnp.stack([x[0], 0 * x[1]]), x)


class Drag(Belt):
    """The same with the wall above, the surfaces in the other order, and a belt that ticks."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.p - self.f * side[1]])

    def switching(self, t, x):
        belt = jnp.where(jnp.mod(t, 2.0) < 1, 0.5, -0.5)
        return jnp.stack([1 - x[0], x[1] - belt])

    def reset(self, t, x, surface):
        return jnp.where(surface == 0, jnp.stack([x[0], 0 * x[1]]), x)

    @property
    def clocks(self):
        return (jf.Clock(1.0),)


@pytest.mark.release
@pytest.mark.parametrize("system", [Belt, pytest.param(Drag, marks=pytest.mark.release)])
def test_a_mass_at_rest_stays_when_the_belt_reverses(system):
    """From rest, and from where it falls to the wall."""
    p, away = np.array([3.0, 0.7, 3.0, 0.7]), np.array([0.0, 0.0, 0.1, 0.1])
    wall, sign = (0, 1) if system is Belt else (1, -1)

    @jax.jit
    @jax.vmap
    def end(p, x):
        return solve(system(p, jnp.asarray(0.5)), jnp.stack([x, 0 * x]), 8.0, 0.05, max_events=64)

    sols = end(jnp.asarray(p), jnp.asarray(wall + sign * away))
    assert set(outcome_names(sols.result)) == {"successful"}
    assert_within(sols.x_final, [[wall, 0.0]] * 4, 64 * EPS)
    # It has crossed the belt's velocity, once each time, and no more.
    assert (sols.num_events <= 12).all()


class ThreeFrictions(jf.System):
    """Two blocks that rub on the ground and on each other: three surfaces, two velocities."""

    F: jax.Array
    a: jax.Array

    def vector_field(self, t, x, side):
        first = self.a * jnp.cos(t) - self.F[0] * side[0] - self.F[2] * side[2]
        return jnp.stack([x[2], x[3], first, self.F[2] * side[2] - self.F[1] * side[1]])

    def switching(self, t, x):
        return jnp.stack([x[2], x[3], x[2] - x[3]])


class Polygon(jf.System):
    """A block in the plane with friction along three directions, under a load that turns."""

    F: jax.Array
    a: jax.Array
    angles: ClassVar = np.pi * np.arange(3) / 3

    def vector_field(self, t, x, side):
        along = jnp.stack([jnp.cos(self.angles), jnp.sin(self.angles)])
        load = self.a[:2] * jnp.cos(t)
        return jnp.concatenate([x[2:], load - self.F[0] / 3 * (along @ side)])

    def switching(self, t, x):
        along = jnp.stack([jnp.cos(self.angles), jnp.sin(self.angles)])
        return x[2:] @ along


def redundant(system, n=24):
    draw = np.random.default_rng(2)
    v = draw.uniform(0.2, 2, (n, 2))
    if system is ThreeFrictions:
        F = draw.uniform([0.5, 0.5, 0.1], 1.5, (n, 3))
        return F, draw.uniform(0.1, 0.95, n) * F[:, 0], v
    F, way = draw.uniform(1, 2, (n, 3)), draw.normal(size=(n, 2))
    load = 0.25 * F[:, :1] * way / np.linalg.norm(way, axis=1)[:, None]
    return F, load * (np.arange(n) >= 8)[:, None], v


@pytest.mark.slow
@pytest.mark.parametrize(
    "system", [pytest.param(ThreeFrictions, marks=pytest.mark.release), Polygon]
)
def test_friction_that_is_redundant_is_one_motion(system):
    """Under loads that are too weak to move them, blocks stop and stay."""

    @jax.jit
    @jax.vmap
    def end(F, a, v):
        x0 = jnp.concatenate([jnp.zeros(2), v])
        sol = solve(system(F, a), x0, 9.0, 0.05, max_events=None)
        return sol.result, sol.x_final

    results, x = end(*map(jnp.asarray, redundant(system)))
    assert set(outcome_names(results)) == {"successful"}
    assert_within(x[:, 2:], np.zeros((24, 2)), 64 * EPS)


class Stack(jf.System):
    """Two blocks on each other on a floor, pulled up by forces f."""

    f: jax.Array
    e: jax.Array
    slides: ClassVar[bool] = False
    floor: ClassVar[int] = 0

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[2:], self.f])

    def switching(self, t, x):
        surfaces = [x[0], x[1] - x[0]]
        return jnp.stack(surfaces[::-1] if self.floor else surfaces)

    def reset(self, t, x, surface):
        mean, half = 0.5 * (x[2] + x[3]), 0.5 * self.e * (x[3] - x[2])
        landed = jnp.stack([x[0], x[1], -self.e * x[2], x[3]])
        met = jnp.stack([x[0], x[1], mean + half, mean - half])
        return jnp.where(surface == self.floor, landed, met)


class StackFromAbove(Stack):
    floor = 1


def accelerations(f):
    """Of the one pair of contacts that push and do not open."""
    matrix, free = np.array([[1.0, -1], [-1, 2]]), np.array([f[0], f[1] - f[0]])
    for on in np.ndindex(2, 2):
        held, force = [k for k in (0, 1) if on[k]], np.zeros(2)
        force[held] = np.linalg.solve(matrix[np.ix_(held, held)], -free[held])
        opening = matrix @ force + free
        if (force[held] > 0).all() and all(opening[k] > 0 for k in (0, 1) if not on[k]):
            return f + np.array([force[0] - force[1], force[1]])
    raise AssertionError


@pytest.mark.slow
@pytest.mark.parametrize("system", [Stack, StackFromAbove])
def test_of_two_contacts_those_open_that_the_reactions_cannot_hold(system):
    draw = np.random.default_rng(0)
    f = np.concatenate([[[10, 1], [-10, -1], [1, 10], [10, -1], [-10, 1], [-1, 0.5]],
                        5 * draw.normal(size=(34, 2))])  # fmt: skip
    e = np.where(np.arange(40) % 2, 0.0, 0.5)
    run = jax.jit(jax.vmap(lambda f, e: solve(system(f, e), jnp.zeros(4), 1.0, 0.125)))
    sols = run(jnp.asarray(f), jnp.asarray(e))
    assert set(outcome_names(sols.result)) == {"successful"}
    a = np.array([accelerations(force) for force in f])
    assert_within(sols.x_final, np.concatenate([a / 2, a], axis=1), 64 * EPS * 20)
    assert_array_equal(sols.num_events, 0)


class Touching(jf.System):
    """Two masses on dry friction, of which the first is at the limit of it at t = 1 alone, where
    the second begins to slip; a share c of what moves the first moves the second too."""

    F: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        first = self.F[0] * (1 - (t - 1) ** 2) - self.F[0] * side[0]
        return jnp.stack([x[2], x[3], first, self.F[1] * (t - side[1]) + self.c * first])

    def switching(self, t, x):
        return x[2:]


@pytest.mark.slow
def test_a_mass_touches_the_limit_of_its_friction_as_another_slips():
    def end(p):
        sol = solve(Touching(p[:2], p[2]), jnp.zeros(4), 2.2)
        return sol.x_final, sol

    def exact(p):
        x, v = p[1] * 1.2**3 / 6, p[1] * 1.2**2 / 2
        return jnp.stack([0 * x, x, 0 * v, v])

    assert_derivatives(end, exact, [[1.0, 0.8, 0.5], [1.2, 1.0, 0.3]], 256, order=1)


class Chain(jf.System):
    """Two masses on springs and dry friction, the first of them driven."""

    amplitude: jax.Array
    omega: jax.Array

    def vector_field(self, t, x, side):
        q, v = x[:2], x[2:]
        pull = jnp.stack([q[1] - q[0], q[0] - 2 * q[1]])
        drive = jnp.stack([self.amplitude * jnp.cos(self.omega * t), 0 * t])
        return jnp.concatenate([v, pull - 0.05 * v - jnp.array([0.1, 0.12]) * side + drive])

    def switching(self, t, x):
        return x[2:]


# The first contacts, by SciPy's DOP853 at rtol 1e-12 from one event to the next, each slip from a
# speed of 1e-13: good to 1e-10.
CHAINS = [[0.1586206896551724, 0.30689655172413793], [0.17793103448275863, 0.25517241379310346]]
CHAIN_TIMES = [
    [2.5894048717543896, 5.463046907643849, 9.921604322715057],
    [2.4718025456784614, 2.7725544731707252, 4.7949084715398715],
]


@pytest.mark.slow
def test_masses_that_shake_down_to_the_limit_of_their_friction_go_on():
    """For twenty periods, in which slips become as small as rounding; with steps of two lengths."""

    def run(p, dt):
        amplitude, omega = p
        options = dict(stepper=diffrax.Dopri8(), max_events=256)
        sol = solve(Chain(amplitude, omega), jnp.zeros(4), 40 * jnp.pi / omega, dt, **options)
        return sol.result, sol.x_final, sol.events.ts[:3]

    lanes = jnp.array(CHAINS * 2), jnp.array([0.1, 0.1, 0.07, 0.07])
    results, x, times = jax.jit(jax.vmap(run))(*lanes)
    assert set(outcome_names(results)) == {"successful"}
    assert_within(times, CHAIN_TIMES * 2, 1e-10)
    # Of fields linear in time and state and of some hundred pieces.
    assert_within(x[2:], x[:2], 2**14 * EPS)


class Slider(jf.System):
    """Block 1 on dry friction, and block 2 that a force −p + rt pushes against it, and later pulls
    away: a stop between the two, and a friction slider beside the stop, in the same direction."""

    p: jax.Array
    r: jax.Array
    F: jax.Array

    def vector_field(self, t, x, side):
        force = self.r * t - self.p - self.F[1] * side[1]
        return jnp.stack([x[2], x[3], -self.F[0] * side[0] + self.F[1] * side[1], force])

    def switching(self, t, x):
        return jnp.stack([x[2], x[3] - x[2], x[1] - x[0]])

    def reset(self, t, x, surface):
        mean = 0.5 * (x[2] + x[3])
        return jnp.where(surface == 2, jnp.stack([x[0], x[1], mean, mean]), x)


@pytest.mark.release
def test_a_slider_beside_a_stop_holds_with_it():
    """What the stop holds leaves the slider undetermined. Block 2 moves at t = (p + F₂)/r, or both
    do from the start, one against the other."""

    def end(p):
        sol = solve(Slider(p[0], p[1], p[2:]), jnp.zeros(4), 3.0)
        return sol.x_final, sol

    def exact(p):
        s = 3.0 - (p[0] + p[3]) / p[1]
        apart = jnp.stack([0 * s, p[1] * s**3 / 6, 0 * s, p[1] * s**2 / 2])
        x = (p[2] - p[0]) * 2.25 + p[1] * 2.25
        v = (p[2] - p[0]) * 1.5 + p[1] * 2.25
        return jnp.where(p[0] > p[2], jnp.stack([x, x, v, v]), apart)

    lanes = [[0.5, 1.0, 1.0, 0.8], [0.9, 1.5, 1.0, 0.3], [0.0, 0.6, 2.0, 0.9]]
    lanes += [[2.0, 0.3, 0.5, 0.4], [3.0, 0.5, 1.0, 2.0]]
    assert_derivatives(end, exact, lanes, 256, order=1)


class Carriage(jf.System):
    """A mass that rubs on the ground between the walls of a carriage at −cos t, which push it."""

    F: jax.Array
    e: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.F * side[0]])

    def switching(self, t, x):
        carriage = -jnp.cos(t)
        return jnp.stack([x[1], x[0] - carriage + 0.3, carriage + 0.3 - x[0]])

    def reset(self, t, x, surface):
        speed = jnp.sin(t)
        return jnp.where(surface == 0, x, x.at[1].set(speed - self.e * (x[1] - speed)))


@pytest.mark.parametrize("t1", [4.5, 5.7])
@pytest.mark.slow
def test_a_wall_that_moves_takes_a_stuck_mass_along(t1):
    """The right wall hits the mass at rest at 5/6, and pushes it until its acceleration cos t is
    that of the friction, F. From there the mass flies, and slows down."""

    def run(F):
        return solve(Carriage(F, jnp.zeros(())), [-1.0, 0.0], t1, dt=0.02)

    def exact(F):
        off = 2 * jnp.pi - jnp.arccos(F)
        x, v, flight = 0.3 - F, jnp.sin(off), t1 - off
        pushed = jnp.stack([0.3 - jnp.cos(t1), jnp.sin(t1)])
        flies = jnp.stack([x + v * flight + F * flight**2 / 2, v + F * flight])
        return jnp.where(t1 < off, pushed, flies)

    sol, F = run(jnp.asarray(0.6)), jnp.asarray(0.6)
    assert outcome_names(sol.result) == "successful"
    assert_within(sol.x_final, exact(F), 1e-13)
    assert_within(jax.jacfwd(lambda F: run(F).x_final)(F), jax.jacfwd(exact)(F), 1e-12)


class Pushed(jf.System):
    """x'' = A cos ωt − F sgn x' before a wall at −d, on which it does not bounce."""

    a: jax.Array
    d: jax.Array
    wall_first: bool = eqx.field(static=True)

    def vector_field(self, t, x, side):
        friction = 0.6 * side[1 if self.wall_first else 0]
        return jnp.stack([x[1], self.a * jnp.cos(0.7 * t) - friction])

    def switching(self, t, x):
        both = [x[0] + self.d, x[1]]
        return jnp.stack(both if self.wall_first else both[::-1])

    def reset(self, t, x, surface):
        return jnp.where(surface == (0 if self.wall_first else 1), x * jnp.array([1.0, 0.0]), x)


@pytest.mark.parametrize("wall_first", [True, False])
@pytest.mark.slow
def test_a_mass_that_friction_holds_at_a_wall_leaves_it(wall_first):
    """It falls on the wall, is pressed against it, then held by its friction alone until A cos ωt
    = F, and then free. At a wall at zero the rounding of x is that of the forces that hold it."""

    def exact(a, d):
        w = 0.7
        start = (2 * jnp.pi - jnp.arccos(0.6 / a)) / w
        s = 9.0 - start
        turn = jnp.cos(9 * w) - jnp.cos(start * w)
        x = -d - a / w**2 * turn - a / w * jnp.sin(start * w) * s - 0.3 * s**2
        return x, a / w * (jnp.sin(9 * w) - jnp.sin(start * w)) - 0.6 * s

    @jax.jit
    @jax.vmap
    def run(a, d):
        def end(a):
            system = Pushed(a, d, wall_first)
            options = dict(stepper=diffrax.Dopri8(), t0=np.pi / 0.7)
            sol = solve(system, jnp.stack([0.3 - d, 0 * d]), 9.0, 0.03, **options)
            return sol.x_final, (sol.x_final, sol.num_events)

        return jax.jacfwd(end, has_aux=True)(a)

    a, d = jnp.array([1.5, 1.5, 1.2, 2.0]), jnp.array([0.0, 0.2, 0.0, 1e-9])
    slopes, (x, counts) = run(a, d)
    values = jax.vmap(exact)(a, d)
    by_a = jax.vmap(jax.jacfwd(exact))(a, d)
    np.testing.assert_allclose(x, np.stack(values, axis=1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(slopes, np.stack(by_a, axis=1), rtol=0, atol=1e-11)
    np.testing.assert_array_equal(counts, 4)
