"""The nearest grazing parameters, against the closed form of a driven low-pass filter.

y' = −c y + a cos ωt swings by a/√(c² + ω²): it grazes a threshold where that is its height. The
nearest point of this set is found by SciPy from the formula alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names
from tests.results import lane

NAMES = "a", "omega", "upper", "lower"
METRIC = np.array([[4.0, 1.0, 0.0, 0.0], [1.0, 3.0, 0.5, 0.0], [0, 0.5, 2.0, 0.3], [0, 0, 0.3, 1]])


def height(value):
    """A threshold, least where its parameter is zero."""
    return 0.2 + value**2


class Filter(jf.System):
    """A low-pass filter between two thresholds, which change nothing."""

    a: jax.Array
    omega: jax.Array
    c: jax.Array
    upper: jax.Array
    lower: jax.Array

    slides = False

    def vector_field(self, t, x, side):
        return self.a * jnp.cos(self.omega * t) - self.c * x

    def switching(self, t, x):
        upper, lower = height(self.upper), height(self.lower)
        return jnp.stack([upper - x[0], lower + x[0]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def made(p, c=0.7):
    """The filter with these values of `NAMES`."""
    a, omega, upper, lower = (jnp.float64(v) for v in p)
    return Filter(a=a, omega=omega, c=jnp.float64(c), upper=upper, lower=lower)


GIVEN = np.array([1.0, 1.2, 0.84, 0.78])


def closest(surface, given=GIVEN, c=0.7):
    """The nearest point of the set of one threshold, and the distance: a root of the equations of
    Lagrange, from the formula."""
    which = 2 + surface

    def equations(u):
        p, multiplier = u[:4], u[4]
        h, square = height(p[which]), c**2 + p[1] ** 2
        slope = np.zeros(4)
        slope[[0, 1, which]] = 2 * p[0], -2 * p[1] * h**2, -2 * h * square * 2 * p[which]
        return np.append(METRIC @ (p - given) + multiplier * slope, p[0] ** 2 - h**2 * square)

    found = scipy.optimize.root(equations, np.append(given, 0.0), tol=1e-14)
    p = found.x[:4]
    assert np.max(abs(equations(found.x))) < 1e-13
    return p, np.sqrt((p - given) @ METRIC @ (p - given))


@pytest.fixture(scope="module")
def orbits():
    """One that grazes nothing yet, one past the lower threshold, and one that was not found."""
    start, given = jnp.zeros(1), jnp.asarray([GIVEN, GIVEN * [1.3, 1, 1, 1], GIVEN * np.nan])

    def one(p):
        return jf.periodic_orbit(made(p), start, steps=20, throw=False)

    return eqx.filter_vmap(one)(given)


@pytest.fixture(scope="module")
def found(orbits):
    return jf.nearest_grazing(made(GIVEN), NAMES, orbits, metric=METRIC, throw=False)


@pytest.mark.release
def test_the_nearest_point_of_both_sets_is_that_of_the_formula(found):
    (_, further), (p, distance) = closest(0), closest(1)
    assert distance < further
    np.testing.assert_allclose(found.values[:2], [p, p], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.distance[:2], distance, rtol=0, atol=1e-10)
    assert found.bifurcation.tangency.surface[:2].tolist() == [1, 1]
    assert found.bifurcation.kind[:2].tolist() == ["grazing", "grazing"]


@pytest.mark.release
def test_each_orbit_has_its_outcome_and_one_is_nearest(found):
    assert outcome_names(found.result).tolist() == [
        "successful",
        "successful",
        "no_tangency_found",
    ]
    assert np.isnan(found.distance[2])
    assert "a batch of shape (3,) in a, omega, upper, lower" in repr(found)
    nearest = found.nearest
    assert nearest.distance == np.min(found.distance[:2])
    assert nearest.nearest is nearest
    told = repr(nearest)
    assert f"distance {float(nearest.distance):.10g} after" in told
    assert f"  omega = {float(nearest.values[1]):.13g}, given 1.2\n" in told
    assert "touches surface 1 from side +1" in told


@pytest.mark.slow
def test_a_place_that_others_next_to_it_are_nearer_than_is_told(orbits):
    """Where both thresholds are least the distance is stationary, but largest along the sets."""
    given, metric = np.array([1.0, 1.2, 0.0, 0.0]), np.diag([1.0, 100.0, 1.0, 1.0])

    def one(p):
        return jf.periodic_orbit(made(p), jnp.zeros(1), steps=20, throw=False)

    past = eqx.filter_vmap(one)(jnp.asarray([given] * 3))
    found = jf.nearest_grazing(made(given), NAMES, past, metric=metric, throw=False)
    assert outcome_names(found.result).tolist() == ["not_nearest"] * 3
    np.testing.assert_allclose(found.values[:, 2:], 0, rtol=0, atol=1e-12)


@pytest.mark.release
def test_its_derivatives_are_those_of_the_formula(orbits):
    orbit = lane(orbits, 0)

    def nearest(p, c):
        at = jf.nearest_grazing(made(p, c), NAMES, orbit, metric=METRIC, throw=False)
        return jnp.append(at.values, at.distance)

    p, c, h = jnp.asarray(GIVEN), jnp.float64(0.7), 1e-5
    by_p, by_c = jax.jacfwd(nearest, (0, 1))(p, c)
    for k, got in enumerate([*by_p.T, by_c]):
        step = h * np.eye(5)[k]
        there, back = (closest(1, GIVEN + s * step[:4], 0.7 + s * step[4]) for s in (1, -1))
        exact = (np.append(*there) - np.append(*back)) / (2 * h)
        np.testing.assert_allclose(got, exact, rtol=0, atol=1e-8)


class Teeth(jf.System):
    """x follows cos 5t + `lift` exp(10 (cos(t − π) − 1)), the third of whose five least values is
    −1 + `lift`, and the others lower by nearly that."""

    lift: jax.Array
    slides = False
    period = 2 * np.pi

    def vector_field(self, t, x, side):
        bump = self.lift * jnp.exp(-10 * (jnp.cos(t) + 1))
        return 10 * jnp.sin(t) * bump - 5 * jnp.sin(5 * t) - (x - jnp.cos(5 * t) - bump)

    def switching(self, t, x):
        return x[0] + 1.05


@pytest.mark.slow
def test_the_nearest_touch_need_not_be_where_the_orbit_is_lowest():
    """Only the third least value depends on `lift`, and it is the farthest from the surface."""
    system = Teeth(jnp.float64(0.3))
    orbit = jf.periodic_orbit(system, jnp.ones(1), steps=100)
    located = jf.find_bifurcation(system, "lift", orbit, "grazing")
    found = jf.nearest_grazing(system, ("lift",), orbit, metric=[4.0])
    np.testing.assert_allclose([located.value, *found.values], -0.05, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.distance, 0.7, rtol=0, atol=2e-7)


@pytest.mark.parametrize(
    "arguments, told",
    [
        ({"parameters": ("a", "a")}, "different parameters, got"),
        ({"parameters": "a"}, "different parameters, got 'a'"),
        ({"parameters": ("a", "b")}, "must be a parameter of Filter"),
        ({"metric": [1.0, -1.0]}, "positive definite matrix of shape"),
        ({"metric": np.eye(3)}, "positive definite matrix of shape"),
        ({"orbit": 1.0}, "must be a jaxfil.Orbit, got"),
    ],
)
def test_a_wrong_argument_is_named(orbits, arguments, told):
    given = {"parameters": ("a", "omega"), "orbit": lane(orbits, 0), **arguments}
    with pytest.raises(ValueError, match=told):
        jf.nearest_grazing(made(GIVEN), **given)
