"""Branches that are closed, and branches of doubled period that join their parent: closed forms.

In y the motion goes to y = ±√(1 − a²), or stays on a circle in (a, r): branches of orbits that are
circles in the plane of the parameter and the state. To look at y from a frame that turns by half
a turn in a period, as a Möbius band does, doubles the period: y = 0 then is an orbit of one period,
y = ±√(1 − a²) one orbit of two, and both periods double at a = ±1."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf


class Ring(jf.System):
    """x = y + sin(t)/5, y' = 1 − (a − 2)² − y²: y = ±√(1 − (a − 2)²), with folds at a = 1 and 3."""

    a: jax.Array

    def vector_field(self, t, x, side):
        y = x - 0.2 * jnp.sin(t)
        return 1 - (self.a - 2) ** 2 - y**2 + 0.2 * jnp.cos(t)

    @property
    def period(self):
        return 2 * np.pi


class Cycles(jf.System):
    """r' = 1/4 − (a − 1)² − (r − 2)², θ' = 1 + a/2 + r/5: circles of radius 2 ± √(1/4 − (a − 1)²),
    with periods of 2π/θ'; folds at a = 1/2 and 3/2."""

    a: jax.Array

    def vector_field(self, t, x, side):
        r = jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        growth = (0.25 - (self.a - 1) ** 2 - (r - 2) ** 2) / r
        turn = 1 + self.a / 2 + r / 5
        return jnp.stack([growth * x[0] - turn * x[1], growth * x[1] + turn * x[0]])


@pytest.mark.release
def test_a_closed_branch_of_a_forced_system_is_followed_once_round():
    orbit = jf.periodic_orbit(Ring(jnp.array(2.3)), jnp.array([0.9]), steps=20)
    branch = jf.continue_orbit(Ring(jnp.array(2.3)), "a", orbit, stop=(0.5, 4.0), max_step=0.05)
    assert branch.ended == ("closed at 2.3",) * 2
    x0, away = np.asarray(branch.orbits.x0)[:, 0], branch.values - 2
    assert_allclose(away**2 + x0**2, 1, rtol=0, atol=1e-9)
    angles = np.unwrap(np.arctan2(x0, away))
    assert_allclose(abs(angles[-1] - angles[0]), 2 * np.pi, rtol=1e-9)
    assert [point.kind for point in branch.points] == ["fold", "fold"]
    values = sorted(point.value for point in branch.points)
    assert_allclose(values, [1, 3], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_closed_branch_of_an_autonomous_system_is_followed_once_round():
    start = jnp.array([2.4, 0.0])
    orbit = jf.periodic_orbit(Cycles(jnp.array(1.2)), start, period=2 * np.pi / 2.1, steps=32)
    branch = jf.continue_orbit(Cycles(jnp.array(1.2)), "a", orbit, stop=(0.0, 2.0), max_step=0.05)
    assert branch.ended == ("closed at 1.2",) * 2
    radii = np.linalg.norm(branch.orbits.x0, axis=1)
    assert_allclose((branch.values - 1) ** 2 + (radii - 2) ** 2, 0.25, rtol=0, atol=1e-8)
    assert_allclose(
        branch.orbits.period, 2 * np.pi / (1 + branch.values / 2 + radii / 5), rtol=1e-8
    )
    assert [point.kind for point in branch.points] == ["fold", "fold"]
    values = sorted(point.value for point in branch.points)
    assert_allclose(values, [0.5, 1.5], rtol=0, atol=1e-8)


class Moebius(jf.System):
    """y' = (1 − (a² + y²)/b²) y, z' = −z, seen from a frame that turns half a turn in 2π."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        c, s = jnp.cos(t / 2), jnp.sin(t / 2)
        p, q = x[0] - 0.3 * jnp.cos(t), x[1] - 0.2 * jnp.cos(t)
        y, z = c * p + s * q, c * q - s * p
        dy, dz = y * (1 - (self.a**2 + y**2) / self.b**2), -z
        dp = c * dy - s * dz - q / 2
        dq = s * dy + c * dz + p / 2
        return jnp.stack([dp - 0.3 * jnp.sin(t), dq - 0.2 * jnp.sin(t)])

    @property
    def period(self):
        return 2 * np.pi


class MoebiusRing(jf.System):
    """The same around the unit circle in the plane of the first two numbers, in time θ."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        r = jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        c, s = x[0] / r, x[1] / r
        # Half an angle of the frame has no value that is continuous all round: products of two do.
        p, q = r - 2, x[2] - c / 5
        cc, ss, cs = (1 + c) / 2, (1 - c) / 2, s / 2
        norm = 1 - (self.a**2 + cc * p**2 + 2 * cs * p * q + ss * q**2) / self.b**2
        along_p, along_q = cc * p + cs * q, cs * p + ss * q
        dp = norm * along_p - (ss * p - cs * q) - q / 2
        dq = norm * along_q - (cc * q - cs * p) + p / 2
        return jnp.stack([dp * c - r * s, dp * s + r * c, dq - s / 5])


@ft.cache
def doublings(autonomous, b=1.0):
    a = jnp.array(-1.1 * b)
    if autonomous:
        system = MoebiusRing(a, jnp.array(b))
        orbit = jf.periodic_orbit(system, jnp.array([2.0, 0.0, 0.2]), period=2 * np.pi, steps=16)
    else:
        system = Moebius(a, jnp.array(b))
        orbit = jf.periodic_orbit(system, jnp.array([0.3, 0.2]), steps=16)
    branch = jf.continue_orbit(system, "a", orbit, stop=1.1 * b, max_step=0.05)
    return system, [point for point in branch.points if point.kind == "period-doubling"]


@pytest.mark.parametrize("autonomous", [False, pytest.param(True, marks=pytest.mark.release)])
def test_both_periods_double_where_the_parameter_says(autonomous):
    _, points = doublings(autonomous)
    assert_allclose([point.value for point in points], [-1, 1], rtol=0, atol=1e-9)


def amplitude(branch, autonomous):
    x0 = np.asarray(branch.orbits.x0)
    if not autonomous:
        return x0[:, 0] - 0.3
    r = np.hypot(x0[:, 0], x0[:, 1])
    half = np.arctan2(x0[:, 1], x0[:, 0]) / 2
    return np.cos(half) * (r - 2) + np.sin(half) * (x0[:, 2] - np.cos(2 * half) / 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "autonomous, which",
    [
        (False, 0),
        *(
            pytest.param(*case, marks=pytest.mark.release)
            for case in ((True, 0), (False, 1), (True, 1))
        ),
    ],
)
def test_a_doubled_branch_ends_where_it_joins_its_parent(autonomous, which):
    system, points = doublings(autonomous)
    branch = jf.continue_orbit(system, "a", points[which], stop=(-1.5, 1.5), max_step=0.05)
    assert_allclose(branch.values**2 + amplitude(branch, autonomous) ** 2, 1, rtol=0, atol=1e-8)
    assert_allclose(branch.orbits.period, 4 * np.pi, rtol=1e-9)
    other = float(points[1 - which].value)
    assert_allclose(branch.values[-1], other, rtol=0, atol=1e-8)
    assert branch.ended[0].startswith("start at ")
    assert branch.ended[1].startswith("the branch of half the period was met at ")
    assert not branch.points
    # Once, not there and back.
    assert (np.diff(branch.values) * other > 0).all()


@pytest.mark.release
def test_a_doubled_orbit_is_followed_to_its_parent_on_both_sides():
    system = Moebius(jnp.array(0.3), jnp.array(1.0))
    orbit = jf.periodic_orbit(system, jnp.array([0.3 + 0.9, 0.2]), periods=2, steps=16)
    branch = jf.continue_orbit(system, "a", orbit, stop=(-1.5, 1.5), max_step=0.05)
    assert all(why.startswith("the branch of half the period") for why in branch.ended)
    assert_allclose(branch.values[[0, -1]], [-1, 1], rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_short_doubled_branch_does_not_slip_onto_its_parent():
    """Of width 1/10, where the parent is at hand everywhere."""
    system, points = doublings(False, 0.1)
    branch = jf.continue_orbit(system, "a", points[0], stop=(-1.5, 1.5), max_step=0.1)
    assert branch.ended[1].startswith("the branch of half the period was met at ")
    assert_allclose(branch.values**2 + amplitude(branch, False) ** 2, 0.1**2, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_one_period_given_as_two_is_a_branch_of_its_own():
    system = Moebius(jnp.array(-1.1), jnp.array(1.0))
    orbit = jf.periodic_orbit(system, jnp.array([0.3, 0.2]), periods=2, steps=16)
    branch = jf.continue_orbit(system, "a", orbit, stop=-0.5)
    assert branch.ended[1] == "a = -0.5 was reached"
    assert_allclose(amplitude(branch, False), 0, rtol=0, atol=1e-8)
