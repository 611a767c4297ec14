"""Curves of folds, period doublings, Neimark–Sacker and branch points.

Maps whose curves are known in closed form, as the ticks of a clock; a pair of gears with backlash
against a table that SciPy made from exact motions between contacts.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf


class Map(jf.System):
    """(x, y) becomes (y, r + a y + b x + c y² + d y³ + e x y) once in a period."""

    r: jax.Array
    a: jax.Array
    b: jax.Array
    c: jax.Array
    d: jax.Array
    e: jax.Array

    period = 1.0
    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.zeros_like(x)

    def tick(self, t, x, clock):
        last, x = x
        squares = self.c * x**2 + self.d * x**3 + self.e * last * x
        return jnp.stack([x, self.r + self.a * x + self.b * last + squares])


def a_map(**parameters):
    known = dict.fromkeys("rabcde", 0.0) | parameters
    return Map(**{name: jnp.float64(value) for name, value in known.items()})


def special(system, parameter, x, stop, kind):
    """The first special point of a kind on the branch of the fixed point near x."""
    orbit = jf.periodic_orbit(system, jnp.array([x, x]), steps=2, stepper=jf.RK4())
    branch = jf.continue_orbit(system, parameter, orbit, stop=stop, max_step=0.2)
    return next(point for point in branch.points if point.kind == kind)


def named(curve):
    return {point.kind: point.values for point in curve.points}


# Hénon's map, y = r + b x − y²: multipliers have the product −b and the sum −2y.
@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, factor, double", [("fold", -1 / 4, "1:1"), ("period-doubling", 3 / 4, "1:2")]
)
def test_curves_of_henons_map(kind, factor, double):
    system = a_map(r=-0.5, b=-0.8, c=-1.0)
    point = special(system, "r", 0.0, -1.0 if kind == "fold" else 3.0, kind)
    curve = jf.continue_bifurcation(system, ("b", "r"), point, stop=-1.1, max_step=0.1)
    b, r = curve.values.T
    assert_allclose(r, factor * (1 - b) ** 2, rtol=1e-12)
    assert_allclose(curve.xs[:, 0], (-1 if kind == "fold" else 1) * (1 - b) / 2, rtol=1e-11)
    assert curve.kinds == (kind,) * len(b)
    assert {*named(curve)} == {double}
    assert_allclose(named(curve)[double], [-1, 4 * factor], rtol=0, atol=1e-9)


@pytest.mark.release
def test_folds_meet_in_a_cusp():
    """y = r + a y − y³: the folds are at a = 1 + 3y², r = −2y³."""
    system = a_map(a=1.5, d=-1.0)
    point = special(system, "r", 0.7, -0.3, "fold")
    stop = -point.value
    curve = jf.continue_bifurcation(system, ("r", "a"), point, stop=stop, max_step=0.1)
    r, a = curve.values.T
    assert_allclose(27 * r**2, 4 * (a - 1) ** 3, rtol=0, atol=1e-12)
    assert_allclose(named(curve)["cusp"], [0, 1], rtol=0, atol=1e-9)


def test_a_period_doubling_turns_subcritical():
    """At a = −1 the map a y + c y² − y³ has the cubic coefficient c² − 1."""
    system = a_map(a=-0.9, c=0.8, d=-1.0)
    point = special(system, "a", 0.0, -1.1, "period-doubling")
    curve = jf.continue_bifurcation(system, ("c", "a"), point, stop=1.2, max_step=0.1)
    assert_allclose(curve.values[:, 1], -1, rtol=1e-12)
    assert {*named(curve)} == {"generalised-doubling"}
    # Third derivatives are differences.
    assert_allclose(named(curve)["generalised-doubling"], [1, -1], rtol=0, atol=1e-6)


def test_a_pair_of_multipliers_from_one_meeting_to_the_other():
    """The product of multipliers, −b − e y, is one, and their sum 2κ = a + 2c y + e x."""
    system = a_map(a=0.5, b=-0.9, c=0.3, e=-0.2, r=0.1)
    point = special(system, "b", 0.0, -1.1, "neimark-sacker")
    curve = jf.continue_bifurcation(system, ("a", "b"), point, stop=(-3, 3), max_step=0.2)
    (a, b), y = curve.values.T, curve.xs[:, 0]
    assert_allclose(0.2 * y - b, 1, rtol=1e-12)
    assert_allclose(0.1 + (a + b - 1) * y + 0.1 * y**2, 0, rtol=0, atol=1e-12)
    # With b = 0.2 y − 1 the fixed point is 0.1 + (a − 2) y + 0.3 y², and 2κ = a + 0.4 y.
    expected = {}
    for name, kappa in {"1:2": -1, "1:3": -0.5, "1:4": 0, "1:1": 1}.items():
        roots = np.roots([0.3 - 0.4, 2 * kappa - 2, 0.1])
        y = roots[np.argmin(abs(roots - 0.02))] if kappa < 1 else 1.0
        expected[name] = [2 * kappa - 0.4 * y, 0.2 * y - 1]
    assert list(named(curve)) == list(expected)
    for name, values in expected.items():
        assert_allclose(named(curve)[name], values, rtol=0, atol=1e-8)
    assert all("the multipliers meet at" in why for why in curve.ended)


@pytest.mark.parametrize("d, c", [(-1.0, 0.0), (0.0, 0.7)])
def test_a_branch_that_crosses(d, c):
    """y = 0 meets a + b + c y + d y² = 1: a pitchfork where c = 0, otherwise transcritical."""
    system = a_map(a=0.5, b=0.1, c=c, d=d)
    point = special(system, "a", 0.0, 1.2, "branch-point")
    assert_allclose(point.value, 0.9, rtol=1e-9)
    crossing = jf.continue_orbit(system, "a", point, stop=(0.5, 1.2), max_step=0.2)
    y = crossing.orbits.x0[:, 0]
    assert_allclose(crossing.values + 0.1 + c * y + d * y**2, 1, rtol=1e-11)
    assert abs(y[-1]) > 0.3
    curve = jf.continue_bifurcation(system, ("b", "a"), point, stop=0.3, max_step=0.2)
    assert_allclose(curve.values.sum(axis=1), 1, rtol=1e-12)
    assert curve.ended[1] == "b = 0.3 was reached"


class Lines(jf.System):
    """A map with the fixed points y = 1 + j p and y = 1 + k p, in the form of `Map`."""

    p: jax.Array
    j: jax.Array
    k: jax.Array

    period = 1.0
    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.zeros_like(x)

    def tick(self, t, x, clock):
        last, y = x
        product = (y - 1 - self.j * self.p) * (y - 1 - self.k * self.p)
        return jnp.stack([y, y + 0.1 * (last - y) - 0.5 * product])


@pytest.mark.parametrize("j, k", [(1.0, 3.0), (3.0, 1.0), (1.0, 1.1), (0.0, 1.0), (1.0, 0.0)])
def test_the_other_one_of_two_lines(j, k):
    system = Lines(jnp.float64(0.2), jnp.float64(j), jnp.float64(k))
    orbit = jf.periodic_orbit(system, jnp.full(2, 1 + 0.2 * j), steps=2, stepper=jf.RK4())
    branch = jf.continue_orbit(system, "p", orbit, stop=-0.2, max_step=0.2)
    (point,) = [point for point in branch.points if point.kind == "branch-point"]
    # The product of both distances is known to eps, so that nearer than this the lines are one.
    apart = np.sqrt(2 * np.finfo(float).eps) / abs(k - j)
    assert_allclose(point.value, 0, rtol=0, atol=2 * apart)
    crossing = jf.continue_orbit(system, "p", point, stop=(-0.2, 0.2), max_step=0.2)
    assert_allclose(crossing.orbits.x0[:, 0], 1 + k * crossing.values, rtol=1e-10)


def test_a_crossing_that_breaks_up_has_no_curve():
    """y = r + a y − y³ has a pitchfork at a = 1 for r = 0 only."""
    system = a_map(a=0.5, d=-1.0)
    point = special(system, "a", 0.0, 1.2, "branch-point")
    curve = jf.continue_bifurcation(system, ("a", "r"), point, stop=(0.5, 1.5))
    assert_allclose(curve.values, [[1.0, 0.0]], rtol=0, atol=1e-9)
    assert all("no branches cross beyond" in why for why in curve.ended)


class Beside(jf.System):
    """x becomes x + r − 1 − (x − 1)² at a tick, beside y, which is multiplied by c A."""

    c: jax.Array
    r: jax.Array
    matrix: jax.Array

    period = 1.0
    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.zeros_like(x)

    def tick(self, t, x, clock):
        first = x[:1] + self.r - 1 - (x[:1] - 1) ** 2
        return jnp.concatenate([first, self.c * (self.matrix @ x[1:])])


QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    "matrix, kind",
    [(-np.eye(4), "period-doubling"), (np.kron(np.eye(2), QUARTER), "neimark-sacker")],
)
def test_several_multipliers_cross_the_circle_at_once_on_a_curve_of_folds(matrix, kind):
    system = Beside(*map(jnp.asarray, (0.8, 1.01, matrix)))
    start = jnp.zeros(5).at[0].set(1.1)
    orbit = jf.periodic_orbit(system, start, steps=2, stepper=jf.RK4())
    fold = jf.SpecialPoint("fold", 1.01, orbit, 0, (), (), np.zeros(6))
    curve = jf.continue_bifurcation(system, ("c", "r"), fold, stop=1.2)
    assert_allclose(curve.values[:, 1], 1, rtol=1e-12)
    assert [point.kind for point in curve.points] == [kind]
    assert_allclose(curve.points[0].values, [1, 1], rtol=1e-9)


class Gears(jf.System):
    """x'' + 0.1 x' + g(x) = 0.1 + a ω² cos ωt, g the stiffness outside of a backlash |x| < 1."""

    error: jax.Array
    omega: jax.Array

    slides = False

    def vector_field(self, t, x, side):
        mesh = jnp.where(side[0] > 0, x[0] - 1, 0.0) + jnp.where(side[1] < 0, x[0] + 1, 0.0)
        force = 0.1 + self.error * self.omega**2 * jnp.cos(self.omega * t)
        return jnp.stack([x[1], force - 0.1 * x[1] - mesh])

    def switching(self, t, x):
        return jnp.stack([x[0] - 1, x[0] + 1])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@ft.cache
def gears():
    """The special points of the branch through the resonance, by their frequency."""
    system = Gears(error=jnp.float64(0.1), omega=jnp.float64(1.4))
    orbit = jf.periodic_orbit(system, jnp.array([1.1, 0.0]), transient=50)
    branch = jf.continue_orbit(system, "omega", orbit, stop=0.5, max_step=0.1)
    points = sorted(branch.points, key=lambda point: point.value)
    return system, {
        kind: [point for point in points if point.kind == kind]
        for kind in ("fold", "period-doubling")
    }


# `fsolve` on the period map and det(M ∓ I), where motions between contacts are matrix exponentials
# (SciPy's `expm`) and contacts are found by `brentq`; residuals are below 1e-14.
TABLE = [
    ("fold", 1, 0.6, 0.236570829151),
    ("fold", 1, 0.9, 0.026617418221),
    ("fold", 0, 0.5, 0.1729961801952),
    ("period-doubling", 0, 0.9, 0.1599981577203),
    ("period-doubling", 0, 1.6, 0.07758476619),
]


@pytest.mark.release
@pytest.mark.parametrize("kind, number, omega, error", TABLE)
def test_gears_with_backlash(kind, number, omega, error):
    system, points = gears()
    free = "omega", "error"
    curve = jf.continue_bifurcation(system, free, points[kind][number], stop=omega, max_step=0.2)
    assert_allclose(curve.values[-1], [omega, error], rtol=1e-11)


@pytest.mark.release
def test_a_fold_meets_a_graze():
    """By `fsolve` as above, with a minimum of x at 1 as the last equation."""
    system, points = gears()
    curve = jf.continue_bifurcation(
        system, ("omega", "error"), points["fold"][1], stop=0.4, max_step=0.2
    )
    assert_allclose(named(curve)["tangency"], [0.4753028544956, 0.5655903955324], rtol=0, atol=1e-9)
    assert curve.ended[1].startswith("no bifurcation was found beyond (0.475")
    ax = curve.plot(jf.plot.page().add_subplot())
    assert [line.get_label() for line in ax.lines] == ["fold", "tangency"]


class Gate(jf.System):
    """x becomes r + 1.5 x − x³ once in a period, and grows at the rate k while the gate is open,
    A cos 2π(t − 0.6) > 1."""

    r: jax.Array
    A: jax.Array
    k: jax.Array

    slides = False
    period = 1.0
    clocks = (jf.Clock(1.0, 0.25),)

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, self.k * x, 0 * x)

    def switching(self, t, x):
        return self.A * jnp.cos(2 * jnp.pi * (t - 0.6)) - 1

    def tick(self, t, x, clock):
        return self.r + 1.5 * x - x**3


# With the gate open for a while its time is a square root of A − 1, which is known to rounding.
@pytest.mark.release
@pytest.mark.parametrize(
    "k, start, stop, atol",
    [
        (0.7, 0.9, 1.2, 1e-12),
        pytest.param(0.7, 1.2, 0.9, 3e-8, marks=pytest.mark.release),
        pytest.param(-0.3, 1.2, 0.9, 3e-8, marks=pytest.mark.release),
        pytest.param(-0.3, 0.9, 1.2, 1e-12, marks=pytest.mark.release),
    ],
)
def test_a_fold_ends_at_a_corner(k, start, stop, atol):
    """With the growth g in a period, folds are at x² = (1.5 − 1/g)/3; the gate opens at A = 1."""
    growth = np.exp(k * np.arccos(min(1, 1 / start)) / np.pi)
    system = Gate(*(jnp.float64(value) for value in (0.0, start, k)))
    guess = jnp.array([np.sqrt(1.5 - 1 / growth)])
    orbit = jf.periodic_orbit(system, guess, steps=8, stepper=jf.RK4())
    branch = jf.continue_orbit(system, "r", orbit, stop=-0.6, max_step=0.1)
    fold = next(point for point in branch.points if point.kind == "fold")
    curve = jf.continue_bifurcation(system, ("A", "r"), fold, stop=stop, max_step=0.1)
    (point,) = curve.points
    x = np.sqrt(0.5 / 3)
    assert point.kind == "tangency"
    assert_allclose(point.values, [1, x**3 - 0.5 * x], rtol=0, atol=atol)


class Regulator(jf.System):
    """x'' = u − 0.7 (1 + cos(2πt/T + 0.7)) above a floor, which it stays clear of, with the force
    u := −k (x − 1) − c x' from each tick on. On the orbit of one period T = 0.6 it is always 0.7,
    up to rounding."""

    k: jax.Array
    c: jax.Array
    slides = False
    period = 0.6
    clocks = (jf.Clock(0.6),)

    def vector_field(self, t, x, side):
        load = 0.7 * (1 + jnp.cos(2 * jnp.pi * t / 0.6 + 0.7))
        return jnp.stack([x[1], x[2] - load, jnp.zeros_like(t)])

    def switching(self, t, x):
        return x[0]

    def tick(self, t, x, clock):
        return x.at[2].set(-self.k * (x[0] - 1) - self.c * x[1])


@pytest.mark.slow
def test_a_tick_that_changes_nothing_but_rounding_is_no_contact():
    """x and x' are multiplied by [[1 − kT²/2, T − cT²/2], [−kT, 1 − cT]] from tick to tick, with
    the determinant 1 where c = kT/2 and the trace 2 − kT²."""
    system = Regulator(jnp.float64(4.0), jnp.float64(2.0))
    orbit = jf.periodic_orbit(system, jnp.array([1.1, 0.2, 0.5]), steps=16)
    branch = jf.continue_orbit(system, "c", orbit, stop=1.0, max_step=0.1)
    assert [point.kind for point in branch.points] == ["neimark-sacker"]
    curve = jf.continue_bifurcation(system, ("k", "c"), branch.points[0], stop=9.0, max_step=0.1)
    assert [point.kind for point in curve.points] == ["1:4", "1:3"]
    found = [point.values for point in curve.points]
    assert_allclose(found, np.array([[2, 0.6], [3, 0.9]]) / 0.36, rtol=0, atol=1e-7)


class Roessler(jf.System):
    """x' = −y − z, y' = x + a y, z' = 1/5 + z (x − c)."""

    a: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([-x[1] - x[2], x[0] + self.a * x[1], 0.2 + x[2] * (x[0] - self.c)])


@pytest.mark.slow
def test_period_doublings_of_an_autonomous_orbit():
    """By `fsolve` on the variational equations by DOP853, with rtol = 1e-12."""
    system = Roessler(jnp.float64(0.2), jnp.float64(2.8))
    guess = jnp.array([5.05733925, 0.0, 1.62755546])
    orbit = jf.periodic_orbit(system, guess, period=5.768, steps=120)
    (point,) = jf.continue_orbit(system, "c", orbit, stop=2.85).points
    curve = jf.continue_bifurcation(system, ("c", "a"), point, stop=(2.6, 3.2), max_step=0.1)
    assert_allclose(curve.values[0], [2.6, 0.2173142628701], rtol=1e-9)
    assert_allclose(curve.values[-1], [3.2, 0.178829698634], rtol=1e-9)
    assert curve.points == []


class Cycles(jf.System):
    """Circles of r' = r (m + n r² − r⁴), run through at the rate 1 + r²; x = 2 is never met."""

    m: jax.Array
    n: jax.Array

    slides = False

    def vector_field(self, t, x, side):
        square = x @ x
        grow = self.m + self.n * square - square**2
        turn = 1 + square
        return jnp.stack([grow * x[0] - turn * x[1], turn * x[0] + grow * x[1]])

    def switching(self, t, x):
        return x[0] - 2


@pytest.mark.release
def test_folds_of_an_autonomous_orbit():
    """Two circles become one where n² = −4m, r² = n/2."""
    system = Cycles(jnp.float64(-0.1), jnp.float64(1.0))
    orbit = jf.periodic_orbit(system, jnp.array([0.94, 0.0]), period=3.3, steps=60)
    branch = jf.continue_orbit(system, "m", orbit, stop=-0.3, max_step=0.1)
    (point,) = branch.points
    curve = jf.continue_bifurcation(system, ("n", "m"), point, stop=0.7, max_step=0.1)
    n, m = curve.values.T
    assert_allclose(m, -(n**2) / 4, rtol=1e-9)
    assert_allclose(np.sum(curve.xs**2, axis=1), n / 2, rtol=1e-8)


@pytest.mark.slow
def test_where_no_curve_begins():
    system, points = gears()
    orbit = eqx.tree_at(lambda orbit: orbit.x0, points["fold"][0].orbit, jnp.array([jnp.nan, 0.0]))
    lost = jf.SpecialPoint("fold", 0.7, orbit, 0, (), (), np.zeros(3))
    free = "omega", "error"
    curve = jf.continue_bifurcation(system, free, lost, stop=0.8, throw=False)
    assert len(curve.values) == 1 and curve.kinds == ("fold",)
    with pytest.raises(eqx.EquinoxRuntimeError):
        jf.continue_bifurcation(system, free, lost, stop=0.8)
    changed = jf.SpecialPoint("contacts", 0.7, orbit, 0, (), (), np.zeros(3))
    message = "`bifurcation` must be a single Bifurcation, or a SpecialPoint of kind fold.*contacts"
    with pytest.raises(ValueError, match=message):
        jf.continue_bifurcation(system, free, changed, stop=0.8)
