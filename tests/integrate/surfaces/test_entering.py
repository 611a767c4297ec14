"""Derivatives of motions that start on a slide or a rest, or that a map puts on one, against closed
forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf


class Belt(jf.System):
    """A block (q, v) on a spring, with dry friction 0.7 on a belt of velocity u."""

    u: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.7 * side])

    def switching(self, t, x):
        return x[1] - self.u


class Placed(jf.System):
    """A slide on p = a whose sides push r, r' = b s. A tick at t = 1 puts p = 1/2."""

    a: jax.Array
    b: jax.Array = eqx.field(default_factory=lambda: jnp.asarray(0.3))
    clocks = (jf.Clock(10.0, 1.0),)

    def vector_field(self, t, x, side):
        return jnp.stack([-side, self.b * side])

    def switching(self, t, x):
        return x[0] - self.a

    def tick(self, t, x, clock):
        return x.at[0].set(0.5)


class Slanted(jf.System):
    """Two surfaces, p = a and q = 0, on which the sides also push what is not constrained:
    r' = q + (3 s₁ + 2 s₂)/10."""

    a: jax.Array

    def vector_field(self, t, x, side):
        r = x[1] + 0.3 * side[0] + 0.2 * side[1]
        return jnp.stack([-side[0] + 0.2 * side[1], -2 * side[1] + 0.4 * side[0], r])

    def switching(self, t, x):
        return jnp.stack([x[0] - self.a, x[1]])


@eqx.filter_jit
def run(system, x0, t1, dt=0.1):
    return jf.solve(system, x0, 0.0, t1, dt, compact=True).x_final


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_a_block_that_starts_on_its_belt(jacobian):
    """Whatever its velocity is, it is at once that of the belt."""
    u, x0 = jnp.asarray(0.3), jnp.array([0.1, 0.3])
    by_u, by_x = jacobian(lambda u, x0: run(Belt(u), x0, 0.95), (0, 1))(u, x0)
    np.testing.assert_allclose(by_u, [0.95, 1], rtol=1e-14)
    np.testing.assert_allclose(by_x, [[1, 0], [0, 0]], rtol=0, atol=1e-14)


def test_a_tick_that_puts_the_state_on_a_slide():
    """At t = 1 it is above p = a, and with any other a it is beside p = a after the tick."""
    by_a = jax.jacfwd(lambda a: run(Placed(a), jnp.array([2.0, 0.0]), 1.5))(jnp.asarray(0.5))
    np.testing.assert_allclose(by_a, [1, -0.3], rtol=1e-13)


@pytest.mark.slow
def test_a_slide_begins_with_a_derivative_that_depends_on_the_field():
    """r changes by b δ where the start is δ off the surface."""

    def end(b, p):
        return run(Placed(jnp.asarray(0.5), b), jnp.stack([p, 0 * p]), 0.5)

    mixed = jax.jacfwd(jax.jacfwd(end, 1))(jnp.asarray(0.3), jnp.asarray(0.5))
    np.testing.assert_allclose(mixed, [0, 1], rtol=0, atol=1e-14)


@pytest.mark.release
def test_a_start_on_two_surfaces_whose_sides_push_aside():
    """S from ∂f/∂w and ∂ψ/∂w, and from a start beside the surfaces."""
    a, x0 = jnp.asarray(0.5), jnp.array([0.5, 0.0, 0.0])
    by_a, by_x = jax.jacfwd(lambda a, x0: run(Slanted(a), x0, 0.5), (0, 1))(a, x0)
    slopes, pushes = np.array([[-1, 0.2], [0.4, -2]]), np.array([0.3, 0.2])
    aside = -pushes @ np.linalg.inv(slopes)
    expected = [[0, 0, 0], [0, 0, 0], [aside[0], aside[1], 1]]
    np.testing.assert_allclose(by_x, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_a, [1, 0, -aside[0]], rtol=0, atol=1e-14)
    off = jnp.array([2e-4, -1e-4, 0.0])
    moved = run(Slanted(a), x0 + off, 0.5, 0.0501)
    np.testing.assert_allclose(moved, run(Slanted(a), x0, 0.5) + by_x @ off, rtol=0, atol=1e-7)


class Table(jf.System):
    """A block (q, v) that slides on a belt of velocity u while a mass (z, w) rests on a floor, and
    presses on it: friction z'' shares."""

    u: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.7 * side[0], x[3], -1 + 0.1 * x[1] - 0.2 * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[1] - self.u, x[2]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, x.at[3].multiply(-0.5), x)


@pytest.mark.release
def test_a_start_on_a_slide_beside_a_rest():
    u, x0 = jnp.asarray(0.3), jnp.array([0.1, 0.3, 0.0, 0.0])
    by_u, by_v = jax.jacfwd(lambda u, v: run(Table(u), x0.at[1].set(v), 0.95), (0, 1))(u, x0[1])
    np.testing.assert_allclose(by_u, [0.95, 1, 0, 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_v, np.zeros(4), rtol=0, atol=1e-14)


class Leaning(jf.System):
    """Two masses (p, q, v, w), coupled by inertia c, of which the first is pressed on a wall at
    p = 0, and the distance r that the first has gone."""

    c: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        push = jnp.stack([-1 - 0 * x[0], self.c - x[1]])
        return jnp.concatenate([x[2:4], push, x[2:3]])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        push = -1.5 * x[2]
        return x.at[2].add(push).at[3].add(-self.c * push)


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_a_start_at_rest(jacobian):
    """What the wall takes from the first mass, it takes c times from the second, the other way."""
    c, x0 = 0.4, jnp.array([0.0, 0.3, 0.0, 0.2, 0.0])
    t = 0.95

    def end(x):
        return run(Leaning(jnp.asarray(c)), x, t)

    by_x = jacobian(end)(x0)
    start = np.array([[c, 0], [1, 0], [0, c], [0, 1]])  # (q, w) by p, q, v and w
    turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
    expected = np.zeros((5, 5))
    expected[[1, 3], :4] = turn @ start.T
    expected[4, [0, 4]] = [-1, 1]
    np.testing.assert_allclose(by_x, expected, rtol=0, atol=1e-13)
    # It falls and bounces for a time of the order of the root of the height.
    for j, small in ((0, 1e-6), (2, 1e-4)):
        moved = end(x0.at[j].add(small)) - end(x0)
        np.testing.assert_allclose(moved / small, by_x[:, j], rtol=0, atol=5e-3)


class PutThere(Leaning):
    """The same, its first mass put to p, with the velocity v, at a tick."""

    p: jax.Array
    v: jax.Array
    clocks = (jf.Clock(10.0, 1.03),)

    def tick(self, t, x, clock):
        return x.at[0].set(self.p).at[2].set(self.v)


@pytest.mark.slow
def test_a_tick_that_puts_the_state_at_rest():
    c, tau = 0.4, 0.95

    def end(put):
        system = PutThere(jnp.asarray(c), put[0], put[1])
        return run(system, jnp.array([5.0, 0.3, 0.0, 0.2, 0.0]), 1.03 + tau)[jnp.array([1, 3, 4])]

    by_put = jax.jacfwd(end)(jnp.zeros(2))
    cos, sin = c * np.cos(tau), c * np.sin(tau)
    np.testing.assert_allclose(by_put, [[cos, sin], [-sin, cos], [-1, 0]], rtol=0, atol=1e-13)


class SwitchedOn(jf.System):
    """A relay that a clock switches on at t = 1, with its set point where the state is."""

    clocks = (jf.Clock(10.0, 1.0),)

    def vector_field(self, t, x, side):
        on = jnp.where(t < 1, 0.0, 1.0)
        return jnp.stack([-side * on, 2 * side * on])

    def switching(self, t, x):
        return jnp.where(t < 1, 1.0, x[0] - 1)


def test_a_surface_that_jumps_onto_the_state():
    # Pushed off by δ the state comes back in the time δ, in which the other number moves by 2δ.
    def end(x, t0):
        return jf.solve(SwitchedOn(), jnp.stack([x, 0 * x]), t0, 2.0, 0.07).x_final

    for t0 in (0.0, 1.0):
        np.testing.assert_allclose(jax.jacfwd(end)(jnp.array(1.0), t0), [0, 2], atol=1e-13)
