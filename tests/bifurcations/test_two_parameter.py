"""Points of codimension two on curves of grazing, against roots that SciPy finds from formulas."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.bifurcations.tangency import FAMILY_NAMES, Conditions
from jaxfil.bifurcations.tangency_curve import TangencyCurve, TangencyPoint, _degeneracy
from tests.pictures import made


class Wave(jf.System):
    """y(t) → cos t up to a threshold d, beyond which it is pushed by 0.3 - k."""

    k: jax.Array
    d: jax.Array

    period = 2 * np.pi

    def vector_field(self, t, x, side):
        return jnp.cos(t) - jnp.sin(t) - x + jnp.where(side < 0, 0.3 - self.k, 0.0)

    def switching(self, t, x):
        return self.d - x[0]


@pytest.mark.slow
def test_grazing_becomes_grazing_sliding_in_a_two_fold():
    """It touches the threshold at d = 1 whatever the field beyond it does, and slides if that leads
    back."""
    system = Wave(k=jnp.float64(0.1), d=jnp.float64(1.2))
    orbit = jf.periodic_orbit(system, jnp.array([1.0]))
    graze = jf.find_bifurcation(system, "d", orbit, "grazing")
    curve = jf.continue_bifurcation(system, ("k", "d"), graze, stop=0.6)
    (point,) = curve.points
    assert (point.kind, point.before, point.after) == ("two-fold", "grazing", "grazing-sliding")
    np.testing.assert_allclose(point.values, [0.3, 1.0], rtol=0, atol=1e-12)
    told = f"  two-fold at k = {point.values[0]:.10g}, d = {point.values[1]:.10g}: grazing to graz"
    assert told in repr(curve)
    ax = curve.plot(jf.plot.page().add_subplot())
    assert ax.lines[-1].get_label() == "two-fold"


class Swing(jf.System):
    """x'' + 0.2x' + (1 + ε cos 2t)x = cos 2t, which passes a threshold d that changes nothing."""

    depth: jax.Array
    d: jax.Array

    slides = False
    period = np.pi

    def vector_field(self, t, x, side):
        drive = jnp.cos(2 * t)
        return jnp.stack([x[1], drive * (1 - self.depth * x[0]) - 0.2 * x[1] - x[0]])

    def switching(self, t, x):
        return self.d - x[0]


def swing(depth):
    """The period map x ↦ M x + m by SciPy, and the largest x of its fixed point's motion."""

    def field(t, x):
        return [x[1], np.cos(2 * t) * (1 - depth * x[0]) - 0.2 * x[1] - x[0]]

    def run(x, **options):
        return scipy.integrate.solve_ivp(
            field, (0, np.pi), x, method="DOP853", rtol=1e-13, atol=1e-13, **options
        )

    origin, *ends = (run(x).y[:, -1] for x in ([0, 0], [1, 0], [0, 1]))
    matrix = np.stack(ends, axis=1) - origin[:, None]
    top = lambda t, x: x[1]  # noqa: E731
    motion = run(np.linalg.solve(np.eye(2) - matrix, origin), events=top)
    return matrix, max(motion.y_events[0][:, 0])


@pytest.mark.release
def test_a_multiplier_of_a_grazing_orbit_reaches_minus_one():
    depth = scipy.optimize.brentq(
        lambda depth: np.linalg.det(swing(depth)[0] + np.eye(2)), 0.2, 0.8, xtol=1e-13
    )
    system = Swing(depth=jnp.float64(0.3), d=jnp.float64(0.5))
    orbit = jf.periodic_orbit(system, jnp.zeros(2))
    graze = jf.find_bifurcation(system, "d", orbit, "grazing")
    curve = jf.continue_bifurcation(system, ("depth", "d"), graze, stop=0.6)
    (point,) = curve.points
    assert (point.kind, point.before, point.after) == ("period-doubling", "grazing", "grazing")
    np.testing.assert_allclose(point.values, [depth, swing(depth)[1]], rtol=0, atol=1e-10)


class Gates(jf.System):
    """x'' + 0.2x' + x = A cos 2t, passing gates at x = high and x = -low that change nothing."""

    amplitude: jax.Array
    high: jax.Array
    low: jax.Array

    slides = False
    period = np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.amplitude * jnp.cos(2 * t) - 0.2 * x[1] - x[0]])

    def switching(self, t, x):
        return jnp.stack([self.high - x[0], x[0] + self.low])


@pytest.mark.release
def test_an_orbit_grazes_two_gates_at_once_where_they_are_equally_far():
    """It reaches A/|1 - 4 + 0.4i| to either side, and touches the upper gate where that is its
    height; beyond the point it also passes the lower one, there and back."""
    reach = 1 / np.hypot(3, 0.4)
    system = Gates(amplitude=jnp.array(1.0), high=jnp.array(0.4), low=jnp.array(0.7 * np.pi / 6))
    orbit = jf.periodic_orbit(system, jnp.zeros(2))
    graze = jf.find_bifurcation(system, "high", orbit, "grazing")
    curve = jf.continue_bifurcation(system, ("amplitude", "high"), graze, stop=1.3)
    np.testing.assert_allclose(curve.values[:, 1], reach * curve.values[:, 0], rtol=1e-10)
    low = 0.7 * np.pi / 6
    (point,) = curve.points
    assert (point.kind, point.before, point.after) == ("double-tangency", "grazing", "grazing")
    np.testing.assert_allclose(point.values, [low / reach, low], rtol=0, atol=1e-10)


@pytest.mark.release
def test_a_parameter_of_a_curve_goes_through_zero():
    """It touches the wall at 1 where the amplitude A is |1 − Ω² + iΩc|."""
    z = 0.3 / (1 - 1.2**2 + 0.12j)
    system = jf.systems.ImpactOscillator(amplitude=0.3, omega=1.2)
    orbit = jf.periodic_orbit(system, jnp.array([z.real, -1.2 * z.imag]))
    graze = jf.find_bifurcation(system, "amplitude", orbit, "grazing")
    curve = jf.continue_bifurcation(
        system, ("damping", "amplitude"), graze, stop=-0.03, max_step=0.1
    )
    assert curve.ended[1] == "damping = -0.03 was reached"
    # Without damping both multipliers are on the unit circle.
    assert [point.kind for point in curve.points] == ["neimark-sacker"]
    np.testing.assert_allclose(curve.points[0].values, [0, 0.44], rtol=0, atol=1e-9)
    damping, amplitude = curve.values.T
    np.testing.assert_allclose(amplitude, np.hypot(0.44, 1.2 * damping), rtol=0, atol=1e-11)


def point(**values):
    names = "h", "rate", "bend", "other_rate", "slide_rate", "slide_bend"
    found = Conditions(**{name: jnp.float64(values.get(name, 1.0)) for name in names})
    return made(TangencyPoint, known=SimpleNamespace(conditions=found))


@pytest.mark.parametrize(
    "family, vanishes, name",
    [
        ("flight", "bend", "cusp"),
        ("flight", "other_rate", "two-fold"),
        ("arrival", "bend", "cusp"),
        ("arrival", "other_rate", "two-fold"),
        ("slide", "slide_bend", "cusp"),
        ("slide", "other_rate", "two-fold"),
    ],
)
def test_a_change_of_the_kind_has_the_name_of_what_vanishes(family, vanishes, name):
    told, test = _degeneracy(FAMILY_NAMES.index(family), point(), point(**{vanishes: -1.0}))
    assert told == name and test(point(**{vanishes: -2.5})) == -2.5


@pytest.mark.release
@pytest.mark.parametrize(("omega", "wall", "stop"), [(1.2, 1.0, 0.9), (0.8, 2.0, 1.6)])
def test_a_tangency_moves_through_the_whole_period(omega, wall, stop):
    # Below the wall the orbit is that of x'' + 0.1 x' + x = A cos ωt, whose size has one curve,
    # without any point of codimension two, through the resonance and its turn of the phase.
    def size(omega):
        return abs(1 - omega**2 + 0.1j * omega)

    system = jf.systems.ImpactOscillator(amplitude=0.3, omega=omega, restitution=0.7, wall=wall)
    z = 0.3 / (1 - omega**2 + 0.1j * omega)
    orbit = jf.periodic_orbit(system, jnp.array([z.real, -omega * z.imag]))
    graze = jf.find_bifurcation(system, "amplitude", orbit, "grazing")
    curve = jf.continue_bifurcation(system, ("omega", "amplitude"), graze, stop=stop)
    assert curve.points == []
    assert curve.ended[1] == f"omega = {stop} was reached"
    exact = [wall * size(w) for w in curve.values[:, 0]]
    assert_allclose(curve.values[:, 1], exact, rtol=1e-9, atol=0)


class Sampled(jf.System):
    """x'' + x'/2 + 2x = cos(t − a) + u below a stop d, with u := −0.3 x' at 16 ticks a period."""

    a: jax.Array
    d: jax.Array

    slides = False
    period = 2 * np.pi
    clocks = (jf.Clock(np.pi / 8, 0.2),)

    def vector_field(self, t, x, side):
        push = jnp.cos(t - self.a) + x[2]
        return jnp.stack([x[1], push - 0.5 * x[1] - 2 * x[0], jnp.zeros_like(t)])

    def switching(self, t, x):
        return self.d - x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)

    def tick(self, t, x, clock):
        return x.at[2].set(-0.3 * x[1])


@pytest.mark.slow
def test_ticks_enter_and_leave_the_flight_of_a_curve_of_grazes():
    """The least stop is max x, the same after half a turn of the force, in which eight ticks pass
    the touch. From just after a tick, by the matrix of (x, x', u, cos t, sin t)."""
    a = 0.4
    matrix = np.zeros((5, 5))
    matrix[0, 1], matrix[1] = 1, [-2, -0.5, 1, 1, 0]
    matrix[3, 4], matrix[4, 3] = -1, 1
    tick = np.eye(5)
    tick[2] = [0, -0.3, 0, 0, 0]
    turn = np.linalg.matrix_power(tick @ scipy.linalg.expm(matrix * np.pi / 8), 16)
    force = [np.cos(0.2 - a), np.sin(0.2 - a)]
    z = np.append(np.linalg.solve(np.eye(3) - turn[:3, :3], turn[:3, 3:] @ force), force)
    tops = []
    for _ in range(16):
        flow = lambda s, z=z: scipy.linalg.expm(matrix * s) @ z  # noqa: E731
        z = tick @ flow(np.pi / 8)
        if flow(0)[1] > 0 > flow(np.pi / 8)[1]:
            time = scipy.optimize.brentq(lambda s, flow=flow: flow(s)[1], 0, np.pi / 8, xtol=1e-14)
            tops.append(flow(time)[0])
    system = Sampled(jnp.float64(a), jnp.float64(0.8))
    orbit = jf.periodic_orbit(system, jnp.array([0.6, 0.3, -0.2]))
    graze = jf.find_bifurcation(system, "d", orbit, "grazing")
    curve = jf.continue_bifurcation(system, ("a", "d"), graze, stop=a + np.pi, max_step=0.1)
    assert curve.points == [] and curve.ended[1].endswith("was reached")
    assert_allclose(curve.values[[0, -1], 1], max(tops), rtol=0, atol=1e-11)


class Turned(TangencyCurve):
    """Grazing orbits whose multipliers are a pair, turned by the angle a + b c and stretched by the
    factor exp(g c)."""

    def correct(self, guess, constraint, along):
        (a, b, g), c = self.equations, guess[0]
        cos, sin = np.cos(a + b * c), np.sin(a + b * c)
        matrix = np.exp(g * c) * np.array([[cos, -sin], [sin, cos]])
        tangent = np.array([1.0, 0.0])
        known = SimpleNamespace(monodromy=matrix, code=0)
        return TangencyPoint(guess, np.ones(2), tangent, 1, known)


@pytest.mark.parametrize(
    "a, b, g, found",
    [
        (np.pi, 0.0, 1.0, ["period-doubling"]),
        (1.0, 0.0, 1.0, ["neimark-sacker"]),
        (1.0, 1.0, 0.0, []),  # on the circle all along, up to rounding
    ],
)
def test_a_pair_of_a_grazing_orbit_crosses_the_circle_at_once_or_stays(a, b, g, found):
    curve = Turned((a, b, g), system=SimpleNamespace(period=1.0))
    points = [curve.correct(np.array([c, 0.0]), None, None) for c in np.linspace(-0.3, 0.4, 20)]
    pairs = itertools.pairwise(points)
    special = [point for pair in pairs for point in curve._critical(*pair)]
    assert [point.kind for point in special] == found
    assert_allclose([point.point.u[0] for point in special], 0, rtol=0, atol=1e-9)
