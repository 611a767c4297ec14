"""Curves of bifurcations of equilibria in two parameters, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.equilibria.planar import Boundary, Hill, PseudoSaddleNode, SoftStop

CLOSE = {"rtol": 0, "atol": 1e-11}


class Hopf(jf.System):
    """x″ = (a − b²) x′ − x − c round x = −c, on side −: a Hopf point at a = b²."""

    a: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], (self.a - self.b**2) * x[1] - x[0] - 1.0])

    def switching(self, t, x):
        return x[0]


def the_point(system, parameter, guess, stop):
    branch = jf.continue_equilibrium(system, parameter, jf.equilibrium(system, guess), stop=stop)
    (point,) = branch.points
    return point


def test_a_curve_of_folds_of_pseudo_equilibria():
    system = PseudoSaddleNode(0.5, 0.25)
    fold = the_point(system, "mu", jnp.array([0.8, 0.0]), -1.0)
    curve = jf.continue_equilibrium_bifurcation(system, ("b", "mu"), fold, stop=(0.1, 0.8))
    assert {*curve.kinds} == {"fold"}
    assert_allclose(curve.values.sum(axis=1), 0.0, **CLOSE)
    assert_allclose(np.sort(curve.values[[0, -1], 0]), [0.1, 0.8], **CLOSE)


def test_a_curve_of_boundary_equilibria_changes_its_kind():
    """On μ = 0 at g = 0, where the pseudo-equilibrium is not there at all."""
    system = Boundary(0.8, 1.0)
    point = the_point(system, "mu", jnp.array([0.1, 0.6]), -0.5)
    curve = jf.continue_equilibrium_bifurcation(system, ("g", "mu"), point, stop=(-1.0, 1.5))
    assert_allclose(curve.values[:, 1], 0.0, **CLOSE)
    assert_allclose(curve.xs, 0.0, **CLOSE)
    expected = np.where(curve.values[:, 0] > 0, "persistence", "nonsmooth-fold")
    assert {*curve.kinds} == {"persistence", "nonsmooth-fold"}
    assert curve.kinds == tuple(expected.tolist())


def test_a_curve_over_a_continuous_boundary_changes_its_kind():
    """Beyond f = 1 there is x = (f + k)/(1 + k), which is above 1 for k > −1 only."""
    point = the_point(SoftStop(0.5, 4.0), "f", jnp.array([0.4, 0.0]), 1.5)
    curve = jf.continue_equilibrium_bifurcation(SoftStop(0.5, 4.0), ("k", "f"), point, stop=-3.0)
    assert_allclose(curve.values[:, 1], 1.0, **CLOSE)
    expected = np.where(curve.values[:, 0] > -1, "persistence", "nonsmooth-fold")
    assert {*curve.kinds} == {"persistence", "nonsmooth-fold"}
    assert curve.kinds == tuple(expected.tolist())


def test_the_kind_is_independent_of_the_direction_of_the_branch():
    """The same two modes, in the other order on a branch that is followed both ways."""
    system = Boundary(0.8, -1.0)
    point = the_point(system, "mu", jnp.array([0.1, 0.6]), (-0.5, 1.5))
    assert point.kind == "nonsmooth-fold"
    curve = jf.continue_equilibrium_bifurcation(system, ("g", "mu"), point, stop=1.0)
    expected = np.where(curve.values[:, 0] > 0, "persistence", "nonsmooth-fold")
    assert curve.kinds == tuple(expected.tolist())


@pytest.mark.release
def test_a_curve_of_rests_on_a_curved_wall():
    system = Hill(0.5, 1.0, 1.0)
    point = the_point(system, "mu", jnp.array([0.01, 0.4, 0.0, 0.0]), -0.2)
    assert point.kind == "persistence"
    curve = jf.continue_equilibrium_bifurcation(system, ("k", "mu"), point, stop=1.5)
    assert {*curve.kinds} == {"persistence"}


def test_a_curve_of_hopf_points():
    system = Hopf(0.5, 0.5)
    point = the_point(system, "a", jnp.array([-1.0, 0.0]), -0.5)
    assert point.kind == "hopf"
    curve = jf.continue_equilibrium_bifurcation(system, ("b", "a"), point, stop=(0.2, 0.9))
    assert_allclose(curve.values[:, 1], curve.values[:, 0] ** 2, **CLOSE)
    assert {*curve.kinds} == {"hopf"}


class Takens(jf.System):
    """x' = y, y' = p + q x + x² + x y, moved to (1, 1): Hopf points at p = 0, with ω² = −q, up to a
    double eigenvalue of zero at q = 0."""

    p: jax.Array
    q: jax.Array

    def vector_field(self, t, x, side):
        x, y = x[0] - 1, x[1] - 1
        return jnp.stack([y, self.p + self.q * x + x**2 + x * y])


def test_a_curve_of_hopf_points_ends_at_a_double_zero():
    system = Takens(-0.2, -1.0)
    point = the_point(system, "p", jnp.array([0.83, 1.0]), 0.1)
    curve = jf.continue_equilibrium_bifurcation(system, ("q", "p"), point, stop=0.5)
    assert_allclose(curve.values[[0, -1]], [[-1, 0], [0, 0]], **CLOSE)
    assert np.all(np.diff(curve.values[:, 0]) > 0)
    assert curve.ended[1].startswith("the eigenvalues meet at zero, at (")


def test_two_names_are_needed():
    system = Boundary(0.8, 1.0)
    with pytest.raises(ValueError, match="`parameters` must be two different parameters"):
        jf.continue_equilibrium_bifurcation(system, ("g",), None, stop=1.0)
