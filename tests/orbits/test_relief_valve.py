"""A pressure relief valve that rattles on its seat: where its orbit is born, and where it grazes.

C. Hős and A. R. Champneys, Grazing bifurcations and chatter in a pressure relief valve model,
Physica D 241 (2012) 2068–2076: κ = 1.25, β = 20, δ = 10, r = 0.8, and the inflow q is varied. The
equilibrium loses its stability in a Hopf bifurcation as q falls, and the orbit grazes the seat near
q = 7.55. Against eigenvalues, and against SciPy's DOP853.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

import jaxfil as jf

KAPPA, BETA, DELTA, R = 1.25, 20.0, 10.0, 0.8
pytestmark = pytest.mark.slow
PRECISE = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}


class ReliefValve(jf.System):
    """Lift, velocity and pressure."""

    q: jax.Array

    def vector_field(self, t, x, side):
        lift, velocity, pressure = x
        force = -KAPPA * velocity - (lift + DELTA) + pressure
        return jnp.stack([velocity, force, BETA * (self.q - lift * jnp.sqrt(pressure))])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -R * x[1], x[2]])


def field(t, y, q):
    force = -KAPPA * y[1] - (y[0] + DELTA) + y[2]
    return [y[1], force, BETA * (q - y[0] * np.sqrt(y[2]))]


def top(t, y, q):
    return y[1]


def seat(t, y, q):
    return y[0]


top.direction = seat.direction = -1
seat.terminal = True


def equilibrium(q):
    """The state, the eigenvalues and the eigenvectors."""
    lift = brentq(lambda y: y * np.sqrt(y + DELTA) - q, 0, 10, xtol=1e-14)
    root_p = np.sqrt(lift + DELTA)
    drain = [-BETA * root_p, 0, -BETA * lift / (2 * root_p)]
    matrix = np.array([[0, 1, 0], [-1, -KAPPA, 1], drain])
    return np.array([lift, 0, lift + DELTA]), *np.linalg.eig(matrix)


@pytest.mark.release
def test_the_orbit_is_born_where_a_pair_of_eigenvalues_crosses():
    """Its period goes to that of the pair as q comes to the Hopf bifurcation."""
    hopf = brentq(lambda q: equilibrium(q)[1].real.max(), 8, 9, xtol=1e-13)
    still, values, vectors = equilibrium(hopf)
    pair = int(np.argmax(values.imag))
    omega, shape = values[pair].imag, (vectors[:, pair] / vectors[0, pair]).real
    qs = hopf - np.array([0.006, 0.012, 0.018])
    # Amplitudes grow as the square root of the distance.
    guesses = still + 1.8 * np.sqrt(hopf - qs)[:, None] * shape

    @eqx.filter_vmap
    def orbits(q, x0):
        found = jf.periodic_orbit(ReliefValve(q), x0, period=2 * np.pi / omega, throw=False)
        return found.period, found.x0, found.result

    periods, x0, results = orbits(jnp.array(qs), jnp.array(guesses))
    assert (results == jf.RESULTS.successful).all()
    assert (abs(x0[:, 0] - still[0]) > 0.1).all()  # and none is the equilibrium itself
    born = np.polyval(np.polyfit(qs - hopf, np.asarray(periods), 2), 0.0)
    np.testing.assert_allclose(born, 2 * np.pi / omega, rtol=1e-4)


def grazing():
    """Pressure and inflow of the orbit whose lowest lift is zero, and its period."""
    low = lambda t, y, q: y[1]  # noqa: E731
    low.direction, low.terminal = 1, True
    period = np.nan

    def gap(unknowns):
        nonlocal period
        pressure, q = unknowns
        off = solve_ivp(field, (0, 0.2), [0, 0, pressure], args=(q,), **PRECISE)
        back = solve_ivp(field, (0.2, 20), off.y[:, -1], args=(q,), events=low, **PRECISE)
        period = back.t_events[0][0]
        lift, _, there = back.y_events[0][0]
        return [lift, there - pressure]

    return *root(gap, [40.0, 7.54], tol=1e-13).x, period


@pytest.mark.release
def test_the_orbit_grazes_its_seat_where_scipy_finds_it():
    pressure, q, period = grazing()
    assert abs(q - 7.55) < 0.01
    system = ReliefValve(jnp.array(q + 0.05))
    # Where the valve is wide open its pressure settles in a twentieth of the unit of time.
    guess = jnp.array([0.1, 0.0, pressure])
    orbit = jf.periodic_orbit(system, guess, period=period, steps=160)
    found = jf.find_bifurcation(system, "q", orbit, "grazing")
    assert found.kind == "grazing"
    np.testing.assert_allclose(found.value, q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.x, [0, 0, pressure], rtol=0, atol=1e-5)


def tops(q, time):
    """The highest lifts of a long motion with impacts, and their number."""
    t, y, found, impacts = 0.0, np.array([1.0, 0.0, 20.0]), [], 0
    while t < time:
        run = solve_ivp(field, (t, time), y, args=(q,), events=[seat, top], **PRECISE)
        found.extend(y[0] for y in run.y_events[1])
        t, y = run.t[-1], run.y[:, -1] * [1, -R, 1]
        # The rounding of the lift, on the side that it comes from.
        y[0], impacts = max(y[0], 1e-15), impacts + 1
    return found, impacts


@pytest.fixture(scope="module")
def diagram():
    return jf.bifurcation_diagram(
        ReliefValve(jnp.array(7.0)),
        "q",
        jnp.array([5.5, 6.5, 8.6]),
        jnp.array([1.0, 0.0, 20.0]),
        transient=80,
        samples=8,
        section=jf.maxima(lambda t, x: x[0]),
        max_return=6.0,
        steps=20,
        compact=True,
        progress=False,
    )


@pytest.mark.release
def test_impacts_below_the_grazing_have_the_lifts_that_scipy_finds(diagram):
    """One at each turn, or at every other; and above the Hopf bifurcation the valve stands still
    but for what has not decayed."""
    assert diagram.successful.all()
    assert diagram.periods()[:2].tolist() == [1, 2]
    one, many = tops(5.5, 150.0)
    assert many > 20
    np.testing.assert_allclose(diagram.xs[0, -1, 0], one[-1], rtol=1e-8)
    two, _ = tops(6.5, 150.0)
    np.testing.assert_allclose(np.sort(diagram.xs[1, -2:, 0]), np.sort(two[-2:]), rtol=1e-6)
    np.testing.assert_allclose(diagram.xs[2, -1], equilibrium(8.6)[0], rtol=0.2, atol=1e-8)
