"""Contacts that have broken trusted codes: one test a case, against answers by hand."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS, EventKind


class Affine(jf.System):
    """x' = a + B x with its own a and B on each side of the line n·x = c."""

    a: jax.Array
    b: jax.Array
    n: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        fields = self.a + self.b @ x
        return jnp.where(side > 0, fields[0], fields[1])

    def switching(self, t, x):
        return self.n @ x - self.c


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
    timed: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(t), side])

    def switching(self, t, x):
        return jnp.prod(jnp.where(self.timed > 0, t, x[0]) - self.roots)


def affine(plus, minus, b_plus=((0, 0), (0, 0)), b_minus=((0, 0), (0, 0)), n=(0, 1), c=0):
    """An `Affine` scene, by default glued along y = 0."""
    return Affine(*(jnp.asarray(v, float) for v in ((plus, minus), (b_plus, b_minus), n, c)))


def corner(field, n=((1, 0), (0, 1)), c=(0, 0)):
    """A `Corner` scene from a function of the two sides, by default with the axes as surfaces."""
    table = [[field(s1, s2) for s2 in (1, -1)] for s1 in (1, -1)]
    return Corner(*(jnp.asarray(v, float) for v in (table, n, c)))


def run(system, x0, t1, dt, ts=None):
    """Three saved times and a table of events, so that all lanes share one compiled program."""
    ts = jnp.linspace(0.0, t1, 3) if ts is None else jnp.asarray(ts, float)
    x0 = jnp.asarray(x0, float)
    saveat = diffrax.SaveAt(ts=ts)
    return jf.solve(system, x0, 0.0, t1, dt, saveat=saveat, max_events=64, throw=False)


def table(sol):
    """Times and kinds of the events that happened."""
    count = int(sol.num_events)
    assert np.all(np.isinf(sol.events.ts[count:]))
    assert np.all(sol.events.kinds[count:] == EventKind.none)
    return np.asarray(sol.events.ts[:count]), sol.events.kinds[:count].tolist()


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
    sol = run(affine((1, -1), (-1, -3)), (0, 1), 1.5, dt, ts=[0.5, 1.0, 1.5])
    ts, kinds = table(sol)
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert kinds == [EventKind.crossing]
    assert_allclose(sol.xs, [[0.5, 0.5], [1, 0], [0.5, -1.5]], atol=1e-14)
    assert_array_equal(sol.modes[:, 0], [1, -1, -1])


@pytest.mark.parametrize("dt", [1.0, 0.5, 0.25, 0.2, 0.1, 0.3])
def test_impact_on_a_saved_time_saves_the_right_limit(dt):
    # From 4.9 at g = 9.8 the floor is reached at t = 1 with speed 9.8 (exact).
    ball = jf.systems.BouncingBall(g=9.8, restitution=0.5)
    sol = run(ball, (4.9, 0), 1.5, dt, ts=[0.5, 1.0, 1.5])
    ts, kinds = table(sol)
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert kinds == [EventKind.impact]
    assert_allclose(sol.xs[1], [0, 4.9], atol=1e-12)
    assert_allclose(sol.xs[2], [1.225, 0], atol=1e-12)
    assert_allclose(sol.events.xs[0], [0, -9.8], atol=1e-12)


def test_same_contact_again_after_the_switch():
    # Bounces at t1 (1 + 2 (e + ... + e^k)), t1 = 10/7: the sixth at 11.96, the seventh at 13.48.
    ball = jf.systems.BouncingBall(g=9.8, restitution=0.9)
    dts = jnp.asarray([0.003, 0.01, 0.1, 0.5, 1.0, 2.6, 13.0])
    sols = jax.vmap(
        lambda dt: jf.solve(ball, jnp.asarray([10.0, 0.0]), 0.0, 13.0, dt, max_events=8)
    )(dts)
    assert_array_equal(sols.num_events, 6)
    powers = np.cumsum(0.9 ** np.arange(6))
    want = np.broadcast_to(10 / 7 * (2 * powers - 1), (7, 6))
    assert_allclose(sols.events.ts[:, :6], want, rtol=1e-12)
    assert_array_equal(sols.events.kinds[:, :6], EventKind.impact)


@pytest.mark.parametrize("timed", [0, 1])
@pytest.mark.parametrize(
    "roots",
    [(0.3, 0.6), (0.5, 0.501), (0.0001, 0.9999), (0.1, 0.4, 0.8), (0.45, 0.5, 0.56)],
)
def test_several_roots_of_one_surface_in_a_step(roots, timed):
    system = Roots(jnp.asarray(roots), jnp.asarray(float(timed)))
    sol = run(system, (0, 0), 1.0, 1.0)
    ts, kinds = table(sol)
    assert_allclose(ts, roots, rtol=1e-11)
    assert kinds == [EventKind.crossing] * len(roots)
    pieces = np.diff([0, *roots, 1]) * (-1) ** np.arange(len(roots), -1, -1)
    assert_allclose(sol.xs[-1], [1, pieces.sum()], atol=1e-11)


def test_several_roots_of_one_surface_in_a_step_of_a_curved_motion():
    # x = cos t dips below -0.999 for 0.09 around pi, within the step from 3 to 3.5.
    turn = ((0, 1), (-1, 0))
    sol = run(affine((0, 0), (0, 0), turn, turn, n=(1, 0), c=-0.999), (1, 0), 5.0, 0.5)
    ts, kinds = table(sol)
    assert_allclose(ts, [np.arccos(-0.999), 2 * np.pi - np.arccos(-0.999)], rtol=1e-7)
    assert kinds == [EventKind.crossing] * 2


@pytest.mark.parametrize(("levels", "end"), [((0.4, 0.9), -7.8), ((0.9, 0.4), 1.2)])
@pytest.mark.parametrize("dt", [1.0, 0.17])
def test_two_surfaces_in_one_step(levels, end, dt):
    # x' = side_1 + 10 side_2: the order of the contacts is in x(1).
    system = corner(lambda s1, s2: (s1 + 10 * s2, 1), n=((0, 1), (0, 1)), c=levels)
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
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert kinds == [EventKind.crossing]
    assert_array_equal(sol.events.members[0], True)
    assert sol.events.surfaces[0] == 0
    assert_allclose(sol.xs[-1], [2, 3], rtol=1e-13)
    assert_array_equal(sol.modes[-1], [1, 1])


@pytest.mark.parametrize("dt", [0.3, 2.0])
def test_both_surfaces_at_once_the_same_surface_listed_twice(dt):
    system = corner(lambda s1, s2: (1, 1.5 + (s1 + s2) / 4), n=((0, 1), (0, 1)))
    sol = run(system, (0, -1), 2.0, dt)
    ts, _ = table(sol)
    assert_allclose(ts, [1.0], rtol=1e-14)
    assert_array_equal(sol.events.members[0], True)
    assert_allclose(sol.xs[-1], [2, 2], rtol=1e-13)
    assert_array_equal(sol.modes[-1], [1, 1])


def test_both_surfaces_at_once_sliding_on_a_surface_listed_twice():
    system = corner(lambda s1, s2: (1, -(s1 + s2) / 2), n=((0, 1), (0, 1)))
    sol = run(system, (0, -1), 2.0, 0.3)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.xs[-1], [2, 0], atol=1e-14)
    assert sol.num_events == 1


@pytest.mark.parametrize("dt", [0.05, 0.3, 0.5, 1.0, 2.0])
def test_grazing_touch(dt):
    # x = t - 1, y = x² until the surface is crossed, which never happens.
    system = affine((1, 0), (1, -5), b_plus=((0, 0), (2, 0)))
    sol = run(system, (-1, 1), 2.0, dt)
    ts, kinds = table(sol)
    assert sol.result == RESULTS.successful
    assert kinds == [EventKind.graze]
    assert_allclose(ts, [1.0], atol=1e-6)
    assert_array_equal(sol.modes[:, 0], 1)
    assert_allclose(sol.xs[-1], [1, 1], rtol=1e-13)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("dt", [0.3, 0.5, 2.0])
def test_grazing_touch_missed_by_a_little(gap, dt):
    parabola = ((0, 0), (2, 0))
    system = affine((1, 0), (1, 0), parabola, parabola)
    above, below = (run(system, (-1, 1 + s * gap), 2.0, dt) for s in (1, -1))
    assert above.num_events == 0
    ts, kinds = table(below)
    assert kinds == [EventKind.crossing] * 2
    assert_allclose(ts, [1 - np.sqrt(gap), 1 + np.sqrt(gap)], atol=1e-15 / np.sqrt(gap) + 1e-13)
