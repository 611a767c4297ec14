"""Surfaces that are coupled: a field that is affine in its sides against the same motion in other
words, which do not show it, and small linear systems against LAPACK."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.integrate.system.lowered import build
from jaxfil.xla import small_linear

PADDING = 8


class Stack(jf.System):
    """Masses on each other, and the lowest on a belt, with friction between neighbours."""

    mu: jnp.ndarray
    shown: bool = eqx.field(static=True)
    more: int = eqx.field(static=True)

    def vector_field(self, t, x, side):
        m = self.mu.size
        # ±1 to the third power is itself; that this is affine is not seen.
        friction = -self.mu * (side if self.shown else side * side * side)
        (q, v), rest = jnp.split(x[: 2 * m], 2), x[2 * m :]
        push = jnp.arange(1.0, m + 1) * (jnp.cos(t) - q)
        forces = push + friction - jnp.append(friction[1:], 0.0)
        return jnp.concatenate([v, forces, -rest])

    def switching(self, t, x):
        m = self.mu.size
        v = x[m : 2 * m]
        return v - jnp.concatenate([jnp.array([0.3]), v[:-1]])


def run(m, shown, more=0):
    stack = Stack(jnp.linspace(0.5, 0.3, m), shown, more)
    x0 = jnp.concatenate([jnp.linspace(0.1, 0.4, 2 * m), jnp.zeros(more)])
    system = build(stack, x0, compact=False)
    assert not system.structure.separate and system.structure.affine == shown
    return jf.solve(stack, x0, 0.0, 8.0, 0.05, max_events=64)


@pytest.mark.release
@pytest.mark.parametrize(
    ("m", "more"),
    [
        (2, 0),
        # More surfaces, and states that are one array.
        pytest.param(2, PADDING + 4, marks=pytest.mark.release),
        pytest.param(3, 0, marks=pytest.mark.release),
        pytest.param(3, PADDING, marks=pytest.mark.release),
    ],
)
def test_affine_or_not_is_one_motion(m, more):
    sol, other = run(m, True, more), run(m, False, more)
    assert int(sol.num_events) == int(other.num_events) >= 4
    # Some of it slides.
    assert np.any(np.asarray(sol.events.modes)[: int(sol.num_events)] == 0)
    assert_allclose(sol.x_final, other.x_final, rtol=1e-11, atol=1e-12)
    assert_allclose(sol.events.ts, other.events.ts, rtol=1e-11)


WORDS = {
    "plainly": lambda f: f + 0.6 * f[::-1],
    "by a conditional": lambda f: jax.lax.cond(
        jnp.sum(f) < 1e3, lambda f: f + 0.6 * f[::-1], lambda f: f, f
    ),
    "by a checkpoint": jax.checkpoint(lambda f: f + 0.6 * f[::-1]),
}


class Pair(jf.System):
    """Two masses with friction, coupled by inertia."""

    word: str = eqx.field(static=True)

    def vector_field(self, t, x, side):
        q, v = jnp.split(x, 2)
        forces = WORDS[self.word](-q - jnp.array([1.0, 0.4]) * side)
        return jnp.concatenate([v, forces + jnp.array([0.3, -0.2]) * jnp.sin(3 * t)])

    def switching(self, t, x):
        return x[2:]


@pytest.mark.release
def test_a_coupling_is_seen_in_whatever_words():
    """A conditional that is given an array and returns one mixes its numbers."""
    x0 = jnp.array([3.0, 1.0, 0.0, 0.5])
    plain, *others = (jf.solve(Pair(word), x0, 0.0, 8.0, 0.05) for word in WORDS)
    for sol in others:
        assert_allclose(sol.x_final, plain.x_final, rtol=1e-12)


@jax.jit
def solved(a, b):
    """By elimination: the solution for each column of b, and the size of the determinant."""
    rows, rights = [list(row) for row in a], [list(column) for column in b.T]
    found = jnp.stack([jnp.stack(x) for x in small_linear.solve_small(rows, rights)], axis=1)
    return found, small_linear.size_of_determinant(rows)


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_small_linear_systems_are_solved_as_by_lapack(k):
    rng = np.random.default_rng(k)
    for _ in range(5):
        a, b = rng.normal(size=(k, k)), rng.normal(size=(k, 3))
        a[0, 0] = 0 if k > 1 else a[0, 0]  # rows are exchanged
        found, size = solved(a, b)
        scale = np.linalg.cond(a) * np.finfo(float).eps
        assert_allclose(found, np.linalg.solve(a, b), rtol=64 * scale, atol=64 * scale)
        assert_allclose(size, abs(np.linalg.det(a)), rtol=64 * scale)


def test_unknowns_that_are_not_asked_for_change_nothing():
    """Nor do they scale the equations, in which their column is larger than rounding permits."""
    a, b = np.array([[1.0, 2, 1e18], [3, 4, 1e18], [1, 1, 1]]), np.array([[5.0], [6], [7]])
    taken = jnp.array([True, True, False])
    found = small_linear.solve(jnp.asarray(a), jnp.asarray(b), taken)
    assert_allclose(found[:, 0], [-4, 4.5, 0], rtol=1e-14)
    assert_allclose(small_linear.size_of_determinant(jnp.asarray(a), taken), 2, rtol=1e-14)


def one_equation_twice(a, x):
    a[1] = a[0]


def an_unknown_without_effect(a, x):
    a[:, 0] = x[0] = 0
    a[-1] = 0


def an_unknown_whose_effect_is_rounding(a, x):
    an_unknown_without_effect(a, x)
    a[:-1, 0] = 1e-17


SINGULAR = [one_equation_twice, an_unknown_without_effect, an_unknown_whose_effect_is_rounding]


@pytest.mark.parametrize("k", [2, 3, 5])
@pytest.mark.parametrize("made", SINGULAR)
def test_a_singular_system_with_a_solution_is_solved(made, k):
    for seed in range(5):
        rng = np.random.default_rng([k, seed])
        a, x = rng.normal(size=(k, k)), rng.normal(size=(k, 3))
        made(a, x)
        a = a[rng.permutation(k)]
        found, size = solved(a, a @ x)
        assert_allclose(a @ found, a @ x, rtol=0, atol=1e-12)
        assert size == 0


class Held(jf.System):
    """x' = d − M sgn x, held at x = 0, and z' = side."""

    matrix: jax.Array
    push: jax.Array

    def vector_field(self, t, x, side):
        return jnp.concatenate([self.push - self.matrix @ side, side])

    def switching(self, t, x):
        return x[: self.push.shape[0]]


@pytest.mark.release
@pytest.mark.parametrize("m", [2, 3, 4])
def test_weights_of_coupled_surfaces_in_reverse_mode(m):
    # The weights are M⁻¹ d, and z is their integral.
    matrix = np.eye(m) + 0.2 * np.arange(m * m).reshape(m, m) / m**2
    push, share = np.linspace(-0.2, 0.3, m), np.linspace(1, 2, m)

    def end(push):
        budget = dict(adjoint=diffrax.RecursiveCheckpointAdjoint(), max_steps=40)
        system = Held(jnp.asarray(matrix), push)
        sol = jf.solve(system, jnp.zeros(2 * m), 0.0, 0.5, 0.1, stepper=jf.RK4(), **budget)
        return share @ sol.x_final[m:]

    found = jax.grad(end)(jnp.asarray(push))
    np.testing.assert_allclose(found, 0.5 * np.linalg.solve(matrix.T, share), rtol=1e-13)
