"""Branches of equilibria and what bounds them, against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from tests.equilibria.planar import (
    Boundary,
    Oscillator,
    PseudoSaddleNode,
    SoftStop,
    Spring,
    TwoSurfaces,
)

# A special point is located to 1e-12 of the unknowns, and Newton's method ends at 256 eps of them.
CLOSE = {"rtol": 0, "atol": 1e-11}


def happened(branch):
    return [(point.kind, point.before, point.after) for point in branch.points]


@pytest.mark.parametrize("g, kind", [(1.0, "persistence"), (-1.0, "nonsmooth-fold")])
def test_a_branch_goes_on_over_a_boundary(g, kind):
    system = Boundary(0.8, g)
    start = jf.equilibrium(system, jnp.array([0.1, 0.6]))
    branch = jf.continue_equilibrium(system, "mu", start, stop=(-0.8, 0.9))
    assert happened(branch) == [(kind, (1,), (0,))] or happened(branch) == [(kind, (0,), (1,))]
    (point,) = branch.points
    assert_allclose([point.value, *point.equilibrium.x], 0.0, **CLOSE)
    slides = branch.equilibria.mode[:, 0] == 0
    mu, x = branch.values, np.asarray(branch.equilibria.x)
    expected = np.where(slides[:, None], np.stack([-0.75 * mu / g, 0 * mu], 1), 0.0)
    expected[~slides, 1] = mu[~slides]
    assert_allclose(x, expected, **CLOSE)
    # Of the regular one to the right, the pseudo-equilibrium beyond, or back.
    assert_allclose(np.sort([mu[0], mu[-1]]), [-0.8, 0.9] if g > 0 else [0.9, 0.9], **CLOSE)
    assert np.all(np.where(slides, branch.stable == (g > 0), branch.stable))
    inner = branch.at(-0.5 if g > 0 else 0.5)
    assert {one.kind for one in inner} == ({"pseudo"} if g > 0 else {"pseudo", "regular"})
    assert f"{kind} at" in repr(branch)


@pytest.mark.parametrize("g", [1.0, -1.0])
def test_a_branch_starts_on_a_boundary(g):
    """For μ < 0 there is the pseudo-equilibrium if g = 1, and none if g = −1."""
    system = Boundary(0.0, g)
    start = jf.equilibrium(system, jnp.array([0.1, 0.6]))
    assert start.kind == "boundary"
    branch = jf.continue_equilibrium(system, "mu", start, stop=-0.8)
    ends = {1.0: "mu = -0.8 was reached", -1.0: "the boundary at surface 0 was met at 0"}
    assert branch.ended[1] == ends[g]
    expected = np.stack([-0.75 * branch.values, 0 * branch.values], axis=1)
    assert_allclose(branch.equilibria.x, expected, **CLOSE)
    assert [point.kind for point in branch.points] == ["persistence" if g > 0 else "nonsmooth-fold"]
    both = jf.continue_equilibrium(system, "mu", start, stop=(-0.8, 0.9))
    assert_allclose(both.values[[0, -1]], [-0.8 if g > 0 else 0.9, 0.9], **CLOSE)


@pytest.mark.parametrize("k, end", [(4.0, 2.0), (-2.0, 0.5)])
def test_a_branch_goes_on_where_the_field_is_continuous(k, end):
    """Forward over a stop, back over one that is softer than nothing."""
    system = SoftStop(0.5, k)
    start = jf.equilibrium(system, jnp.array([0.4, 0.0]))
    branch = jf.continue_equilibrium(system, "f", start, stop=(0.5, 2.0))
    assert happened(branch) == [("persistence" if k > -1 else "nonsmooth-fold", (-1,), (1,))]
    assert_allclose(branch.points[0].value, 1.0, **CLOSE)
    f, x = branch.values, np.asarray(branch.equilibria.x)[:, 0]
    assert f[-1] == end
    assert_allclose(x, np.where(x > 1, (f + k) / (1 + k), f), **CLOSE)


def test_pseudo_equilibria_meet_in_a_fold():
    system = PseudoSaddleNode(0.5, 0.25)
    start = jf.equilibrium(system, jnp.array([0.8, 0.0]))
    branch = jf.continue_equilibrium(system, "mu", start, stop=(-1.0, 0.75))
    (point,) = branch.points
    assert (point.kind, point.before) == ("fold", (0,))
    assert_allclose(point.value, -0.25, **CLOSE)
    x = np.asarray(branch.equilibria.x)[:, 0]
    assert_allclose(x**2, branch.values + 0.25, **CLOSE)
    assert_allclose(np.sort(x[[0, -1]]), [-1.0, 1.0], **CLOSE)
    # The eigenvalue of the slide, which attracts.
    assert_allclose(branch.eigenvalues[:, 0], -x, **CLOSE)
    # Nearer to the fold than the points of the branch.
    value = 0.5 * (point.value + np.min(branch.values))
    beside = np.sort([at.x[0] for at in branch.at(value)])
    assert_allclose(beside, np.array([-1, 1]) * (value + 0.25) ** 0.5, rtol=1e-9)


def test_a_branch_leaves_two_surfaces_one_after_the_other():
    system = TwoSurfaces(0.5)
    branch = jf.continue_equilibrium(system, "a", jf.equilibrium(system, jnp.zeros(2)), stop=4.0)
    assert happened(branch) == [
        ("persistence", (0, 0), (0, -1)),
        ("persistence", (0, -1), (1, -1)),
    ]
    assert_allclose([point.value for point in branch.points], [2.5, 3.0], **CLOSE)
    assert_allclose(branch.equilibria.x[-1], [1.0, -1.0], **CLOSE)
    assert branch.ended == ("start at 0.5", "a = 4 was reached")


def test_a_spring_comes_to_rest_on_its_wall():
    system = Spring(0.5)
    start = jf.equilibrium(system, jnp.array([0.4, 0.0]))
    branch = jf.continue_equilibrium(system, "f", start, stop=-0.5)
    assert happened(branch) == [("persistence", (1,), (2,))]
    assert_allclose(branch.points[0].value, 0.0, **CLOSE)
    assert_allclose(branch.equilibria.multipliers[-1], [0.5], **CLOSE)
    assert branch.stable.all()


def test_a_hopf_point():
    system = Oscillator(0.5)
    start = jf.equilibrium(system, jnp.array([0.1, 0.9]))
    branch = jf.continue_equilibrium(system, "a", start, stop=-0.5)
    assert happened(branch) == [("hopf", (1,), (1,))]
    assert_allclose(branch.points[0].value, 0.0, **CLOSE)
    assert branch.stable.tolist() == (branch.values < 0).tolist()


class Pairs(jf.System):
    """Two equal oscillators on their own, z' = (a + i)(z − 1 − i)."""

    a: jax.Array

    def vector_field(self, t, x, side):
        x, y = x.reshape(2, 2) - 1
        return jnp.concatenate([self.a * x - y, x + self.a * y])


def test_two_pairs_cross_the_axis_at_once():
    system = Pairs(0.5)
    start = jf.equilibrium(system, jnp.full(4, 1.1))
    branch = jf.continue_equilibrium(system, "a", start, stop=-0.5)
    assert happened(branch) == [("hopf", (), ())]
    assert_allclose(branch.points[0].value, 0.0, **CLOSE)


def test_a_virtual_equilibrium_is_on_no_branch():
    system = Boundary(-0.8, 1.0)
    virtual = jf.equilibrium(system, jnp.array([0.1, 0.6]))
    with pytest.raises(ValueError, match="`equilibrium` must be one of the system, got a virtual"):
        jf.continue_equilibrium(system, "mu", virtual, stop=0.8)


def test_a_branch_that_does_not_begin_has_the_outcome_of_its_start():
    system = Boundary(0.8, 1.0)
    lost = jf.equilibrium(system, jnp.array([np.nan, 0.6]), throw=False)
    branch = jf.continue_equilibrium(system, "mu", lost, stop=0.1, throw=False)
    assert branch.result == jf.RESULTS.nonfinite
    assert branch.values.tolist() == [0.8]


class Feedback(jf.System):
    """c' = s/(1 + (a/K)²) − 0.05 c, a' = c − 0.1 a, and a fifth less of c in it beyond a = θ."""

    s: jax.Array
    K: jax.Array
    theta: jax.Array

    def vector_field(self, t, x, side):
        made = jnp.where(side > 0, 1.0, 0.8) * x[0]
        return jnp.stack([self.s / (1 + (x[1] / self.K) ** 2) - 0.05 * x[0], made - 0.1 * x[1]])

    def switching(self, t, x):
        return self.theta - x[1]


def feedback(s, unit):
    return Feedback(*(jnp.asarray(v * unit) for v in (s, 10.0, 12.0)))


def below(s):
    """The state below θ: a/K is the real root of u³ + u = 20 s."""
    u = np.roots([1, 0, 1, -20 * s])
    u = np.real(u[np.argmin(abs(np.imag(u)))])
    return np.array([u, 10 * u])


def test_an_equilibrium_is_as_accurate_in_every_unit():
    """In pmol/l, in mol/l and beyond."""
    right = below(0.13)
    guesses = jnp.asarray([[0.3, 3.0], [2.0, 0.4], [0.0, 0.0], [0.0, 1.0]])
    for unit in (1.0, 1e-12, 1e30):
        system = feedback(0.13, unit)
        find = lambda x: jf.equilibrium(system, x, mode=1, throw=False)  # noqa: E731, B023
        found = eqx.filter_vmap(find)(unit * guesses * right)
        assert_allclose(found.x / (unit * right), 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 1e-12])
def test_a_branch_is_the_same_in_every_unit(unit):
    """It is held at θ from s = 0.06 (1 + 1.2²) on, and beyond it from 5/4 of that on."""
    first = 0.06 * (1 + 1.2**2)
    start = jf.equilibrium(feedback(0.12, unit), jnp.asarray(unit * below(0.12)))
    branch = jf.continue_equilibrium(start.system, "s", start, stop=0.2 * unit)
    assert happened(branch) == [("persistence", (1,), (0,)), ("persistence", (0,), (-1,))]
    places = [point.value / unit for point in branch.points]
    assert_allclose(places, [first, 1.25 * first], rtol=1e-12)
    assert np.all(branch.equilibria.admissible)


class PressedOn(jf.System):
    """A mass on a spring, pressed on a wall at q = 0 if c < 0, and a friction there that grows with
    the contact force: q'' = c − q − q' (1 + λ)."""

    c: jax.Array
    slides = False

    def vector_field(self, t, x, side, reaction):
        return jnp.stack([x[1], self.c - x[0] - x[1] * (1.0 + reaction)])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return x.at[1].multiply(-0.5)


def test_a_branch_ends_where_a_rest_would_be_felt_by_the_field():
    system = PressedOn(jnp.asarray(0.5))
    start = jf.equilibrium(system, jnp.array([0.5, 0.0]), mode=1)
    branch = jf.continue_equilibrium(system, "c", start, stop=-0.5)
    assert_allclose(branch.values[[0, -1]], [0.5, 0.0], **CLOSE)
    assert branch.ended[1].startswith("the boundary at surface 0 was met at ")
    assert np.all(branch.equilibria.mode == 1)


class Latched(jf.System):
    """x″ = μ x′ − x − x′³ beside memories that nothing changes."""

    mu: jax.Array

    def vector_field(self, t, x, side):
        still = jnp.zeros_like(x[2:])
        return jnp.concatenate([jnp.stack([x[1], self.mu * x[1] - x[0] - x[1] ** 3]), still])


@pytest.mark.parametrize("memories", [1, 2])
def test_memories_are_no_eigenvalues_of_a_branch(memories):
    system, x0 = Latched(jnp.array(-0.5)), jnp.append(jnp.array([0.1, 0.0]), jnp.ones(memories))
    branch = jf.continue_equilibrium(system, "mu", jf.equilibrium(system, x0), stop=0.5)
    (point,) = branch.points
    assert point.kind == "hopf"
    assert_allclose(point.value, 0.0, **CLOSE)
    away = abs(branch.values) > 1e-9
    np.testing.assert_array_equal(branch.stable[away], (branch.values < 0)[away])
