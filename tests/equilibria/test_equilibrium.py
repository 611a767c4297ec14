"""Equilibria and pseudo-equilibria against closed forms, with eigenvalues and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.equilibria.planar import Boundary, Circle, Relays, Spring, TwoSurfaces

EPS = np.finfo(float).eps
# Of numbers of order one that a few operations make.
CLOSE = {"rtol": 64 * EPS, "atol": 64 * EPS}


@pytest.mark.parametrize(
    "mu, g, kind, across", [(-0.5, 1.0, "pseudo", -np.inf), (0.5, -1.0, "pseudo", np.inf)]
)
def test_a_pseudo_equilibrium_of_a_flat_surface(mu, g, kind, across):
    found = jf.equilibrium(Boundary(mu, g), jnp.array([0.2, 0.0]))
    assert (found.kind, found.mode.tolist(), bool(found.admissible)) == (kind, [0], True)
    assert_allclose(found.x, [-0.75 * mu / g, 0.0], **CLOSE)
    assert_allclose(found.multipliers, [(g + mu) / (g - mu)], **CLOSE)
    expected = sorted([-g / (g - mu), across], reverse=True)
    assert_allclose(found.eigenvalues, expected, **CLOSE)
    # A pseudo-saddle where the sides repel.
    assert bool(found.stable) == (across < 0)


def test_one_equilibrium_is_of_the_system_or_virtual():
    guess = jnp.array([0.1, 0.6])
    regular = jf.equilibrium(Boundary(0.5, 1.0), guess)
    assert (regular.kind, regular.mode.tolist()) == ("regular", [1])
    assert_allclose(regular.x, [0.0, 0.5], **CLOSE)
    assert_allclose(regular.eigenvalues, [-1.0, -1.0], **CLOSE)
    assert_allclose(regular.margins, [0.5], **CLOSE)
    virtual = jf.equilibrium(Boundary(-0.5, 1.0), guess)
    assert (virtual.kind, bool(virtual.admissible)) == ("virtual regular", False)
    assert not bool(virtual.stable)
    # By its mode, from anywhere: that of a slide with the weight 3.
    beyond = jf.equilibrium(Boundary(0.5, 1.0), guess, mode=0)
    assert beyond.kind == "virtual pseudo"
    assert_allclose(beyond.multipliers, [3.0], **CLOSE)
    assert jf.equilibrium(Boundary(0.0, 1.0), guess).kind == "boundary"


def test_pseudo_equilibria_of_a_curved_surface():
    """From a guess off the circle too, whose mode is given."""
    k = 0.6
    for sign, kind in ((1, "pseudo"), (-1, "virtual pseudo")):
        found = jf.equilibrium(Circle(k), jnp.array([0.9 * sign, 0.2]), mode=0)
        assert found.kind == kind
        assert_allclose(found.x, [sign, 0.0], **CLOSE)
        assert_allclose(found.multipliers, [(1 - sign * k) / (1 + sign * k)], **CLOSE)
        value = -k / (sign + k) * sign
        assert_allclose(found.eigenvalues[0 if sign > 0 else 1], value, rtol=1e-14)


def test_derivatives_of_a_weight_and_of_an_eigenvalue():
    k = jnp.float64(0.6)

    def found(k):
        return jf.equilibrium(Circle(k), jnp.array([0.9, 0.2]), mode=0)

    weight = lambda k: found(k).multipliers[0]  # noqa: E731
    assert_allclose(jax.grad(weight)(k), -2 / (1 + k) ** 2, rtol=64 * EPS)
    assert_allclose(jax.jacfwd(jax.grad(weight))(k), 4 / (1 + k) ** 3, rtol=256 * EPS)
    rate = jax.grad(lambda k: jnp.real(found(k).eigenvalues[0]))(k)
    assert_allclose(rate, -1 / (1 + k) ** 2, rtol=256 * EPS)


class Tank(jf.System):
    """x' = 1 − p x² above 0, √(−x) below, which is not a number above."""

    p: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, 1 - self.p * x**2, jnp.sqrt(-x))

    def switching(self, t, x):
        return x[0]


@pytest.mark.slow
def test_the_jacobian_beside_a_side_that_is_not_a_number_has_reverse_mode():
    """It is −2√p at x = 1/√p."""
    slope = jax.grad(lambda p: jf.equilibrium(Tank(p), jnp.array([0.9])).jacobian[0, 0])
    p = jnp.asarray(0.8)
    assert_allclose(slope(p), -(p**-0.5), rtol=64 * EPS)
    assert_allclose(jax.jacfwd(slope)(p), 0.5 * p**-1.5, rtol=256 * EPS)


def test_a_pseudo_equilibrium_of_two_surfaces():
    found = jf.equilibrium(TwoSurfaces(1.5), jnp.zeros(2))
    assert (found.kind, found.mode.tolist()) == ("pseudo", [0, 0])
    assert_allclose(found.x, 0.0, **CLOSE)
    assert_allclose(found.multipliers, [0.3, -0.6], **CLOSE)
    assert found.eigenvalues.real.tolist() == [-np.inf] * 2
    assert bool(found.stable)
    assert jf.equilibrium(TwoSurfaces(4.0), jnp.zeros(2)).kind == "virtual pseudo"
    one = jf.equilibrium(TwoSurfaces(2.75), jnp.array([0.0, -0.3]))
    assert one.mode.tolist() == [0, -1]
    assert_allclose(one.x, [0.0, -0.5], **CLOSE)
    assert_allclose(one.multipliers, [0.75, -1.0], **CLOSE)
    # On x = 0 the weight is such that ẋ = 0: it does not depend on y.
    assert_allclose(one.eigenvalues, [-1.0, -np.inf], **CLOSE)


# Turns by which the distance grows, although the trace is negative, and shrinks, although it is
# positive; slides to the origin and, by the last one, away from it along one axis.
RELAYS = [
    ([[-1.5, 10.0], [-2.0, 1.0]], [np.inf, np.inf]),
    ([[-1.0, 2.0], [-10.0, 1.5]], [-np.inf, -np.inf]),
    ([[-3.0, 1.0], [2.0, -1.0]], [-np.inf, -np.inf]),
    ([[-3.0, 2.0], [2.0, -1.0]], [np.inf, -np.inf]),
]


@pytest.mark.parametrize("unit", [[1.0, 1.0], [1.0, 20.0], [20.0, 1.0]])
def test_two_surfaces_attract_as_the_motion_does_whatever_their_units(unit):
    """Half a turn, leg by leg, multiplies the distance by (a + b)(c + d)/((c − d)(b − a)), with the
    rows (a, b) and (−c, d): 2.22 and 0.45."""
    found = eqx.filter_vmap(
        lambda b: jf.equilibrium(Relays(b, jnp.array(unit)), jnp.zeros(2), throw=False)
    )(jnp.array([b for b, _ in RELAYS]))
    assert found.eigenvalues.real.tolist() == [across for _, across in RELAYS]
    assert found.stable.tolist() == [False, True, True, False]


def test_an_equilibrium_at_rest_on_a_wall():
    held = jf.equilibrium(Spring(-0.5), jnp.zeros(2))
    assert (held.kind, held.mode.tolist()) == ("rest", [2])
    assert_allclose(held.multipliers, [0.5], **CLOSE)
    assert bool(held.stable)
    assert jf.equilibrium(Spring(0.5), jnp.zeros(2)).kind == "virtual rest"
    assert_allclose(jf.equilibrium(Spring(0.5), jnp.array([0.3, 0.0])).x, [0.5, 0.0], **CLOSE)


def test_a_batch_has_an_outcome_and_a_kind_for_each_lane():
    mus = jnp.array([-0.5, 0.0, 0.5])
    solve = lambda mu: jf.equilibrium(Boundary(mu, 1.0), jnp.array([0.1, 0.6]), throw=False)  # noqa: E731
    found = eqx.filter_vmap(solve)(mus)
    assert found.kind.tolist() == ["virtual regular", "boundary", "regular"]
    assert found.admissible.tolist() == [False, True, True]
    assert_allclose(found.eigenvalues, -np.ones((3, 2)), **CLOSE)
    assert repr(found) == "Equilibrium: a batch of shape (3,), states of 2"


def test_where_there_is_none_the_outcome_says_so():
    none = jf.piecewise(lambda t, x: 1 + x**2, lambda t, x: 1 + x**2, lambda t, x: x[0])
    found = jf.equilibrium(none, jnp.array([0.7]), throw=False)
    assert found.result in (jf.RESULTS.newton_stalled, jf.RESULTS.newton_singular)
    assert not bool(found.admissible)
    with pytest.raises(RuntimeError, match="Newton's method"):
        jf.equilibrium(none, jnp.array([0.7]))


def test_a_forced_system_and_another_mode_are_refused():
    with pytest.raises(ValueError, match=r"`system` must be autonomous.*SDOscillator has a period"):
        jf.equilibrium(jf.systems.SDOscillator(), jnp.zeros(2))
    with pytest.raises(ValueError, match=r"`mode` must be 1 of the numbers −2, .*got 3\."):
        jf.equilibrium(Boundary(0.5, 1.0), jnp.zeros(2), mode=3)
    with pytest.raises(ValueError, match=r"`mode` must be .*, and not be traced"):
        jax.jit(lambda mode: jf.equilibrium(Boundary(0.5, 1.0), jnp.zeros(2), mode=mode))(0)


class Threshold(jf.System):
    """A relaxation towards c, and a threshold at 1 that only counts."""

    c: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return self.c - x

    def switching(self, t, x):
        return x[0] - 1.0


def test_a_guess_on_a_surface_without_slides_is_on_a_side():
    """A weight there is undetermined, since both fields are equal."""
    found = jf.equilibrium(Threshold(jnp.asarray(2.5)), jnp.array([1.0]))
    assert (found.kind, found.mode.tolist()) == ("regular", [1])
    assert_allclose(found.x, [2.5], **CLOSE)


def test_what_has_no_reset_cannot_rest():
    with pytest.raises(ValueError, match="`mode` must be −1, 0 or 1, since Threshold has no reset"):
        jf.equilibrium(Threshold(jnp.asarray(2.5)), jnp.array([1.0]), mode=2)


def test_derivatives_by_a_number_that_functions_close_over():
    """x' = k - x³ rests at the cube root of k."""

    def rest(k):
        field = lambda t, x: jnp.stack([k - x[0] ** 3])  # noqa: E731
        return jf.equilibrium(
            jf.piecewise(field, field, lambda t, x: x[0] - 9.0), jnp.array([1.2])
        ).x[0]

    k = jnp.array([0.7, 2.0])
    value, slope = jax.vmap(jax.value_and_grad(rest))(k)
    assert_allclose(value, jnp.cbrt(k), **CLOSE)
    assert_allclose(slope, k ** (-2 / 3) / 3, **CLOSE)
    assert_allclose(jax.grad(rest)(1.0), 1 / 3, **CLOSE)
