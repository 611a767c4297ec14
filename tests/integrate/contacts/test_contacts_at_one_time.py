"""Contacts at one time: each has the derivative of its own time.

Balls that land together and have nothing to do with each other have the derivatives of balls, and
twins the multipliers and exponents of one. Against closed forms, the orbit of one oscillator, and
the limit of a twisting controller (A. Levant, International Journal of Control 58 (1993)
1247–1263), which may fall on a step.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.linalg import expm

import jaxfil as jf
from jaxfil import EventKind
from tests.results import (
    assert_derivatives,
    assert_within,
    by_imaginary_part,
    kinds_of,
    outcome_names,
)

EPS = np.finfo(float).eps
OPTIONS = dict(stepper=jf.RK4(), compact=True, max_events=16, throw=False)
IMPACT, CROSS = EventKind.impact, EventKind.crossing


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    return jf.solve(system, jnp.asarray(x0), t0, t1, dt, **(OPTIONS | options))


class Balls(jf.System):
    """Balls that fall on floors of their own, each with its restitution."""

    e: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        v = x[self.e.size :]
        return jnp.concatenate([v, -jnp.ones_like(v)])

    def switching(self, t, x):
        return x[: self.e.size]

    def reset(self, t, x, surface):
        return x.at[self.e.size + surface].multiply(-self.e[surface])


def flights(h, e, t1):
    """Heights and speeds of balls dropped from h, after one bounce each."""
    lands = jnp.sqrt(2 * h)
    up, s = e * lands, t1 - lands
    return jnp.concatenate([up * s - s**2 / 2, up - s])


BALLS = [[0.5, 0.5, 0.8, 0.8], [0.5, 0.5 + 1e-9, 0.8, 0.7], [0.5, 0.6, 0.9, 0.6]]


@pytest.mark.release
def test_balls_that_land_together_have_the_derivatives_of_each():
    def end(p):
        sol = solve(Balls(p[2:]), jnp.concatenate([p[:2], 0 * p[:2]]), 1.8)
        return jnp.concatenate([sol.x_final, sol.events.ts[:2]]), sol

    def exact(p):
        times = jnp.sqrt(2 * p[:2])
        return jnp.concatenate([flights(p[:2], p[2:], 1.8), times])

    sols = assert_derivatives(end, exact, BALLS, 1024)
    assert kinds_of(sols) == [[IMPACT] * 2] * 3


@pytest.mark.release
def test_three_of_them_too():
    def end(p):
        sol = solve(Balls(jnp.array([0.8, 0.7, 0.6])), jnp.concatenate([p, 0 * p]), 1.5)
        return sol.x_final, sol

    def exact(p):
        return flights(p, jnp.array([0.8, 0.7, 0.6]), 1.5)

    assert_derivatives(end, exact, [[0.5, 0.5, 0.5], [0.5, 0.6, 0.5]], 1024, order=1)


class Ledge(jf.System):
    """Three masses without forces, restitution 1/2. The first two may run into each other; the
    second has a ledge at 0 below it, and the third one of its own."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[3:], jnp.zeros(3)])

    def switching(self, t, x):
        return jnp.stack([x[1] - x[0], x[1], x[2]])

    def reset(self, t, x, surface):
        v0, v1, v2 = x[3:]
        push = 0.75 * (v1 - v0)
        met = jnp.stack([v0 + push, v1 - push, v2])
        after = jnp.stack([met, jnp.stack([v0, -v1 / 2, v2]), jnp.stack([v0, v1, -v2 / 2])])
        return x.at[3:].set(after[surface])


@pytest.mark.release
def test_an_impact_that_another_one_prevents_is_not_made():
    """All three are met at t = 1; the first impact throws the second mass up from its ledge."""
    sol = solve(Ledge(), [-3.0, 1.0, 1.0, 3.0, -1.0, -1.0], 2.0, 0.25)
    assert_array_equal(sol.events.surfaces[: int(sol.num_events)], [0, 2])
    assert_within(sol.x_final, [0, 2, 0.5, 0, 2, 0.5], 8 * EPS)


class Crossings(jf.System):
    """Each state has a rate of 1 below its surface, and its own one above it; the last state is
    the first surface. Without a reset, or with one that does nothing."""

    rates: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side[::-1] > 0, self.rates, 1.0)

    def switching(self, t, x):
        return x[::-1]


class CrossingsWithReset(Crossings):
    def reset(self, t, x, surface):
        return x


class CrossingsTogether(Crossings):
    """The same written in one formula, in which the sides seem to feel each other."""

    def vector_field(self, t, x, side):
        some = 1 + 0 * side[0] * side[1]
        return some * super().vector_field(t, x, side)


SYSTEMS = [
    Crossings,
    pytest.param(CrossingsWithReset, marks=pytest.mark.release),
    CrossingsTogether,
]


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_crossings_at_one_time_have_the_derivatives_of_each(system):
    def end(p):
        sol = solve(system(p[2:]), p[:2], 2.0)
        return sol.x_final, sol

    def exact(p):
        return p[2:] * (2 + p[:2])

    lanes = [[-1.0, -1.0, 2.0, 3.0], [-1.1, -1.0, 2.0, 3.0], [-1.03, -1.03, 0.5, 4.0]]
    sols = assert_derivatives(end, exact, lanes, 256, order=1)
    assert_array_equal(sols.num_events, 2)
    assert_within(sols.events.ts[:, :2], [[1, 1], [1, 1.1], [1.03, 1.03]], 64 * EPS)


class TickAndContact(jf.System):
    """x' = 1 below 0 and a above it; y' = 1 before a tick at s and b after it."""

    a: jax.Array
    b: jax.Array
    s: jax.Array

    def vector_field(self, t, x, side):
        late = jnp.floor((t - self.s) / 10.0) >= 0
        slow = 1 + 0 * t
        return jnp.stack([jnp.where(side > 0, self.a, slow), jnp.where(late, self.b, slow)])

    def switching(self, t, x):
        return x[0]

    @property
    def clocks(self):
        return (jf.Clock(10.0, self.s),)


@pytest.mark.slow
def test_a_tick_and_a_contact_at_one_time_have_their_own_derivatives():
    """On a grid point, off it, and a little apart."""

    def end(p):
        a, b, s, x = p
        sol = solve(TickAndContact(a, b, s), jnp.stack([-x, 0 * x]), 2.0)
        return sol.x_final, sol

    def exact(p):
        a, b, s, x = p
        return jnp.stack([a * (2 - x), s + b * (2 - s)])

    lanes = [[2.0, 3.0, 1.0, 1.0], [2.0, 3.0, 1.03, 1.03], [2.0, 3.0, 1.04, 1.02]]
    sols = assert_derivatives(end, exact, lanes, 256)
    assert kinds_of(sols) == [[CROSS]] * 3


class Twins(jf.System):
    """Two impact oscillators in phase, x'' + 0.1 x' + x = a cos ωt, x ≤ 1, that may be coupled."""

    k: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        q, v = x[:2], x[2:]
        push = 0.8 * jnp.cos(1.2 * t) - 0.1 * v - q + self.k * (q[::-1] - q)
        return jnp.concatenate([v, push])

    def switching(self, t, x):
        return 1 - x[:2]

    def reset(self, t, x, surface):
        return x.at[2 + surface].multiply(-0.8)

    @property
    def period(self):
        return 2 * jnp.pi / 1.2


@pytest.fixture(scope="module")
def one():
    """The orbit of one of them."""
    system = jf.systems.ImpactOscillator(amplitude=0.8, omega=1.2)
    return jf.periodic_orbit(system, jnp.array([0.5, 0.5]), transient=200)


def multipliers_of_twins(one, k):
    """Of the modes in phase and in opposition. The second sees the stiffness 1 + 2k; both the
    impact at τ, whose saltation matrix is [[−e, 0], [(e a⁻ + a⁺)/v⁻, −e]]: the same for both, as
    the coupling is without force at an impact of twins."""
    event = jax.tree.map(lambda leaf: leaf[0], one.events)
    x, t = np.asarray(event.xs), float(event.ts)
    e, T = 0.8, 2 * np.pi / 1.2

    def acceleration(v):
        return 0.8 * np.cos(1.2 * t) - 0.1 * v - x[0]

    before, after = acceleration(x[1]), acceleration(-e * x[1])
    jump = np.array([[-e, 0], [(e * before + after) / x[1], -e]])

    def flow(h, stiffness):
        return expm(h * np.array([[0, 1], [-stiffness, -0.1]]))

    each = (flow(T - t, s) @ jump @ flow(t, s) for s in (1, 1 + 2 * k))
    return np.concatenate([np.linalg.eigvals(m) for m in each])


@pytest.mark.release
@pytest.mark.parametrize("k", [0.0, 0.05])
def test_twins_have_the_multipliers_of_one(one, k):
    x0 = jnp.repeat(one.x0, 2)
    orbit = jf.periodic_orbit(Twins(jnp.asarray(k)), x0, throw=False)
    assert orbit.result == jf.RESULTS.successful
    assert int(one.events.kinds[1]) == EventKind.none
    got = by_imaginary_part(np.asarray(orbit.multipliers))
    # Newton's method leaves the orbit some 1e-12 away.
    assert_within(abs(got - by_imaginary_part(multipliers_of_twins(one, k))), np.zeros(4), 1e-10)


class Twisting(jf.System):
    """x'' = −a sgn x − b sgn x', which comes to the origin by infinitely many turns."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.a * side[0] - self.b * side[1]])

    def switching(self, t, x):
        return x


def twisting_time(p):
    """Turns of which each takes q times as long as the last, q² = (a − b)/(a + b)."""
    a, b, x, _ = p
    down = jnp.sqrt(2 * x / (a - b)) + jnp.sqrt(2 * (a - b) * x) / (a + b)
    return (down / (1 - jnp.sqrt((a - b) / (a + b))))[None]


@pytest.mark.release
def test_the_limit_of_turns_on_a_step_has_its_derivatives():
    """The first lane of each step ends at 2.5, which the steps 0.05 and 0.1 meet."""

    def limit(p):
        a, b, x, dt = p
        options = dict(stepper=diffrax.Midpoint(), max_events=64)
        dt = jax.lax.stop_gradient(dt)
        sol = solve(Twisting(a, b), jnp.stack([x, 0 * x]), 6.0, dt, **options)
        return sol.events.ts[sol.num_events - 1][None], sol

    lanes = [[5.0, 3.0, x, dt] for dt in (0.05, 0.1, 0.07) for x in (1.0, 4.0, 2.0)]
    # 1e-11: the last turns have the rounding of the first, and rates that grow as they shorten.
    assert_derivatives(limit, twisting_time, lanes, 2**16, order=1)


class Cradle(jf.System):
    """Three equal pendulums that hang beside each other; neighbours throw each other back."""

    e: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.concatenate([x[3:], -x[:3]])

    def switching(self, t, x):
        return x[1:3] - x[:2]

    def reset(self, t, x, surface):
        push = 0.5 * (1 + self.e) * jnp.diff(x[3:])[surface]
        number = jnp.arange(3, dtype=jnp.int32)
        sign = jnp.where(number == surface, 1.0, jnp.where(number == surface + 1, -1.0, 0.0))
        return jnp.concatenate([x[:3], x[3:] + push * sign])


def collided(v, e, first):
    """The velocities after contacts of neighbours at one time, from the pair `first` on."""
    v = v.copy()
    while any(v[:2] > v[1:] + 4 * EPS):
        pair = first if v[first] > v[first + 1] + 4 * EPS else 1 - first
        push = 0.5 * (1 + e) * (v[pair + 1] - v[pair])
        v[pair : pair + 2] += push, -push
        first = 1 - pair
    return v


@pytest.mark.parametrize("e", [0.5, 0.8, 0.95])
@pytest.mark.slow
def test_a_few_contacts_at_one_time_are_no_accumulation(e):
    """All flights last π. Two contacts of one pair at one time come after a long flight, and no
    third one."""
    start, method = [-1.0, -1.0, 0.0, 0.0, 0.0, 0.0], diffrax.Dopri8()
    sol = solve(Cradle(jnp.asarray(e)), start, 6.0, dt=0.05, stepper=method)
    v = collided(np.array([1.0, 1.0, 0.0]), e, 1)
    # Which of two pairs that meet at one time is first is left to rounding.
    ends = [collided(-v, e, first) for first in (0, 1)]
    wants = [np.append(u * np.sin(6 - 1.5 * np.pi), u * np.cos(6 - 1.5 * np.pi)) for u in ends]
    assert outcome_names(sol.result) == "successful"
    assert min(np.max(abs(sol.x_final - want)) for want in wants) <= 64 * EPS
