"""The hard cases again in float32, to 1e-4, from t0 = 0 and from t0 = 1000."""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind


class Affine(jf.System):
    """x' = a + B x with its own a and B on each side of y = 0."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        fields = self.a + self.b @ x
        return jnp.where(side > 0, fields[0], fields[1])

    def switching(self, t, x):
        return x[1]


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


class Roots(jf.System):
    """A clock, a counter of its sides, and H with the given roots in the clock."""

    roots: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(t), side])

    def switching(self, t, x):
        return jnp.prod(x[0] - self.roots)


class Crossing(Affine):
    slides: ClassVar[bool] = False


class Phase(jf.System):
    """A clock that is put back to zero whenever it comes to 0.7."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.ones_like(x)

    def switching(self, t, x):
        return 0.7 - x[0]

    def reset(self, t, x, surface):
        return x - 0.7


def affine(plus, minus, b=((0, 0), (0, 0))):
    return Affine(*(jnp.asarray(v, jnp.float32) for v in ((plus, minus), (b, b))))


def corner(field, n=((1, 0), (0, 1)), c=(0, 0)):
    table = [[field(s1, s2) for s2 in (1, -1)] for s1 in (1, -1)]
    return Corner(*(jnp.asarray(v, jnp.float32) for v in (table, n, c)))


BALL = jf.systems.BouncingBall(g=9.8, restitution=0.9)
SPIRAL = jf.systems.FilippovSpiral()
COULOMB = jf.systems.CoulombOscillator(friction=0.4)
CROSS, STICK, SLIP = EventKind.crossing, EventKind.stick, EventKind.slip
BOUNCES = list(10 / 7 * (2 * np.cumsum(0.9 ** np.arange(6)) - 1))
Y_TWICE = ((0, 1), (0, 1))

# The hard cases of the float64 tests: system, x0, span, dt, end, times and kinds of the events.
CASES = {
    "starts on the surface": (affine((1, 1), (-1, 2)), (0, 0), 1, 0.3, (1, 1), [], []),
    "starts sliding": (affine((3, -1), (1, 3)), (0, 0), 1, 0.3, (2.5, 0), None, None),
    "contact on a grid point": (
        affine((1, -1), (-1, -3)),
        (0, 1),
        1.5,
        0.25,
        (0.5, -1.5),
        [1],
        [CROSS],
    ),
    "same contact again": (BALL, (10, 0), 12.5, 0.2, None, BOUNCES, [EventKind.impact] * 6),
    "two roots in a step": (
        Roots(jnp.asarray([0.3, 0.6], jnp.float32)),
        (0, 0),
        1,
        1.0,
        (1, 0.4),
        [0.3, 0.6],
        [CROSS] * 2,
    ),
    "three roots in a step": (
        Roots(jnp.asarray([0.1, 0.4, 0.8], jnp.float32)),
        (0, 0),
        1,
        1.0,
        (1, 0),
        [0.1, 0.4, 0.8],
        [CROSS] * 3,
    ),
    "two surfaces in one step": (
        corner(lambda s1, s2: (s1 + 10 * s2, 1), Y_TWICE, (0.9, 0.4)),
        (0, 0),
        1,
        1.0,
        (1.2, 1),
        [0.4, 0.9],
        [CROSS] * 2,
    ),
    "both surfaces at once": (
        corner(lambda s1, s2: (1.5 + s1 / 2, 2 + s2)),
        (-1, -1),
        2,
        0.3,
        (2, 3),
        [1],
        [CROSS],
    ),
    "held surface": (
        corner(lambda s1, s2: (s1, -s2), Y_TWICE, (0.5, 1)),
        (0, 0),
        10,
        0.3,
        (9, 1),
        [0.5, 1],
        [CROSS, STICK],
    ),
    "grazing touch": (
        affine((1, 0), (1, 0), ((0, 0), (2, 0))),
        (-1, 1),
        2,
        0.3,
        (1, 1),
        None,
        None,
    ),
    "chattering": (affine((1, -1), (1, 1)), (0, 1), 5, 0.3, (5, 0), [1], [STICK]),
    "spiral": (SPIRAL, (0, 1), 1, 0.1, (0, 0), None, None),
    "chain": (
        COULOMB,
        (3, 0),
        15,
        0.1,
        (-0.2, 0),
        list(np.pi * np.arange(1, 5)),
        [CROSS] * 3 + [STICK],
    ),
    "fold": (
        jf.systems.VisibleFold(),
        (-1, 0.1),
        2.5,
        0.1,
        (-1 + 0.67137021917, -1 - 0.67137021917),
        [0.34159842485, 1.82862978083],
        [STICK, SLIP],
    ),
}


def run(system, x0, t0, span, dt):
    """A float32 run: the system's leaves may be of either precision."""
    x0 = jnp.asarray(x0, jnp.float32)
    sol = jf.solve(system, x0, t0, t0 + span, dt, max_events=64, throw=False)
    assert sol.xs.dtype == sol.ts.dtype == sol.events.ts.dtype == jnp.float32
    return sol


@pytest.mark.parametrize("t0", [0.0, 1000.0])
@pytest.mark.parametrize("name", list(CASES))
def test_float32(name, t0):
    system, x0, span, dt, end, times, kinds = CASES[name]
    sol = run(system, x0, t0, span, dt)
    assert sol.result == RESULTS.successful
    # Times near 1000 are themselves 6e-5 apart.
    if times is not None:
        assert_array_equal(sol.events.kinds[: int(sol.num_events)], kinds)
        assert_allclose(sol.events.ts[: len(times)] - t0, times, atol=1e-4 if t0 == 0 else 2e-4)
    if end is not None:
        assert_allclose(sol.xs[-1], end, atol=1e-4 * max(1, np.abs(end).max()) * (1 + (t0 > 0)))


@pytest.mark.parametrize("t0", [0.0, 1000.0])
@pytest.mark.parametrize(
    ("system", "x0", "result", "t_final"),
    [
        (affine((1, 1), (1, -1)), (0, 0), RESULTS.nonunique, 0),
        (
            corner(lambda s1, s2: (1, s2) if s1 > 0 else (s2 * -1, 1)),
            (-1, -1),
            RESULTS.nonunique,
            1,
        ),
        (jf.systems.BouncingBall(g=9.8, restitution=0.5), (10, 0), RESULTS.zeno, 30 / 7),
        (affine((1, np.nan), (1, 1)), (0, -1), RESULTS.nonfinite, 1),
    ],
    ids=["repelling slide", "corner exit", "zeno", "nan"],
)
def test_float32_outcomes(system, x0, result, t_final, t0):
    sol = run(system, x0, t0, 10.0, 0.3)
    assert sol.result == result
    resolution = 0.3 if result == RESULTS.nonfinite else 1e-4 * (1 + t0)
    assert_allclose(sol.t_final - t0, t_final, rtol=1e-4, atol=resolution)


def test_float32_slip_shorter_than_a_step():
    # Belt case 1 at omega = 1.4: see the float64 test; exact per piece (mpmath).
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.4)
    sol = run(belt, (1.5670473725058692, 1), 0.0, 2 * np.pi / 1.4, 0.1)
    times = [0.021115703825789773, 2.61911511215335305, 2.74881294392022106, 2.9398327291587959]
    assert_array_equal(sol.events.kinds[:4], [SLIP, STICK, SLIP, STICK])
    assert_allclose(sol.events.ts[:4], times, atol=1e-4)


@pytest.mark.parametrize(("dtype", "kind"), [(jnp.float32, Crossing), (jnp.float64, Affine)])
def test_contact_behind_a_grid_point_by_less_than_times_are_told_apart(dtype, kind):
    # All numbers but the time of the contact, 64 (1 + 4 eps), are exact in both precisions.
    t, eps = 64.0, float(jnp.finfo(dtype).eps)
    fields = jnp.asarray(((0, -1), (0, -2)), dtype)
    system, x0 = kind(fields, jnp.zeros((2, 2), dtype)), jnp.asarray((0, t * (1 + 4 * eps)), dtype)
    sol = jf.solve(system, x0, 0.0, t + 1, 0.25, max_events=64, throw=False)
    assert sol.result == RESULTS.successful
    assert_array_equal(sol.events.kinds[:2], [CROSS, EventKind.none])
    assert_allclose(sol.events.ts[0], t * (1 + 4 * eps), rtol=eps)
    assert_allclose(sol.xs[-1, 1], -2 * (1 - 4 * eps * t), rtol=4 * eps)


def test_float32_contacts_long_after_the_start_shift_nothing():
    # Times near 2000 are 1.2e-4 apart, phases 6e-8.
    sol = jf.solve(Phase(), jnp.asarray([0.0], jnp.float32), 0.0, 2000.5, 0.3, max_events=None)
    assert_allclose(sol.xs[-1], 2000.5 % float(np.float32(0.7)), atol=2e-5)


def test_float32_lanes_of_a_long_sweep():
    # The orbit at 0.7: 60-digit reference. What rounding of times sets is eps |t x'|.
    sd, x0 = jf.systems.SDOscillator(), np.array([2.972909733962379342, 0.618617859127108525])
    omegas = np.append(0.7, np.linspace(0.6, 1.3, 63))
    d = jf.bifurcation_diagram(
        sd, "omega", omegas, np.float32(x0), transient=200, samples=100, steps=32, progress=False
    )
    assert d.xs.dtype == np.float32 and d.successful.all()
    ts = 2 * np.pi / 0.7 * np.arange(201, 301)
    rate = np.asarray(sd.vector_field(0.0, x0, 1.0))
    assert np.all(abs(d.xs[0] - x0) <= 1.5 * np.finfo(np.float32).eps * np.outer(ts, abs(rate)))


@pytest.mark.parametrize("t0", [0.0, 1000.0])
def test_float32_derivative_of_the_coulomb_oscillator(t0):
    def end(x0, friction, adjoint):
        system = jf.systems.CoulombOscillator(friction=friction)
        sol = jf.solve(system, x0, t0, t0 + 20, 0.1, adjoint=adjoint, max_steps=256)
        return sol.xs[-1, 0]

    args = jnp.asarray([3.0, 0.0], jnp.float32), jnp.asarray(0.4, jnp.float32)
    for adjoint in (diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()):
        take = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.jacrev
        d_x0, d_friction = take(end, (0, 1))(*args, adjoint)
        assert_allclose(d_x0, [1, 0], atol=1e-3)
        assert_allclose(d_friction, -8, rtol=1e-4)


@pytest.mark.parametrize("gap", [1e-1, 1e-2])
def test_float32_derivative_near_grazing(gap):
    # t* = v - √(v² - 2h) for a throw against gravity 1.
    level = jnp.asarray((1 - gap) / 2, jnp.float32)
    system = jf.piecewise(
        lambda t, x: jnp.stack([x[1], -jnp.ones_like(t)]),
        lambda t, x: jnp.stack([x[1], -jnp.ones_like(t)]),
        lambda t, x: x[0] - level,
    )

    def time(v):
        return jf.solve(system, jnp.stack([0 * v, v]), 0.0, 3.0, 0.3).events.ts[0]

    d_t = jax.jacfwd(time)(jnp.asarray(1.0, jnp.float32))
    assert_allclose(d_t, 1 - 1 / np.sqrt(1 - 2 * float(level)), rtol=1e-4 / gap)
