"""Derivatives across a switch and near a graze: one test a case, against answers by hand."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil import EventKind


class Level(eqx.Module):
    """H = x - c, to be handed to `piecewise`."""

    c: jax.Array

    def __call__(self, t, x):
        return x[0] - self.c


class Rise(jf.System):
    """A throw against gravity 1, and a third component that counts the sides of x = level."""

    level: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t), side])

    def switching(self, t, x):
        return x[0] - self.level


@pytest.mark.slow
def test_derivative_across_a_switch():
    # y' = 1 below c, 2 above: y(T) = 2 T - c from 0. A plain `where` gives dy/dc = 0.
    up, down = (lambda t, x: jnp.full(1, 2.0)), (lambda t, x: jnp.ones(1))

    def end(c, adjoint):
        system = jf.piecewise(up, down, Level(c))
        return jf.solve(system, jnp.zeros(1), 0.0, 3.0, 0.2, adjoint=adjoint).xs[-1, 0]

    c = jnp.asarray(1.1)
    forward, reverse = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
    assert_allclose(end(c, forward), 4.9, rtol=1e-14)
    assert_allclose(jax.jacfwd(end)(c, forward), -1, rtol=1e-13)
    assert_allclose(jax.grad(end)(c, reverse), -1, rtol=1e-13)
    assert_allclose((end(c + 1e-4, forward) - end(c - 1e-4, forward)) / 2e-4, -1, rtol=1e-9)


def rise(v, level):
    """Time of the first contact, and the final state, of a throw at speed v."""
    x0 = jnp.stack([jnp.zeros_like(v), v, jnp.zeros_like(v)])
    sol = jf.solve(Rise(level), x0, 0.0, 5.0, 0.3, max_events=4)
    return sol.events.ts[0], sol.xs[-1, 2], sol.events.kinds[0]


def test_derivative_near_grazing():
    # t* = v - √(v² - 2h); above the level for 2√(v² - 2h), so x3(5) = 4√(v² - 2h) - 5.
    gaps = np.asarray([1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
    levels = (1 - gaps) / 2
    root = np.sqrt(1 - 2 * levels)
    speeds = jnp.ones(6)
    d_t, d_x, _ = jax.jvp(jax.vmap(rise), (speeds, jnp.asarray(levels)), (speeds, 0 * speeds))[1]
    assert_allclose(d_t, 1 - 1 / root, rtol=1e-8)
    assert_allclose(d_x, 4 / root, rtol=1e-8)


def test_derivative_at_grazing():
    # v² = 2h: the contact time's derivative is infinite, the motion beyond it stays below.
    two = jnp.asarray(2.0)
    (t, x, kind), (d_t, d_x, _) = jax.jvp(rise, (two, two), (jnp.ones(()), jnp.zeros(())))
    assert kind == EventKind.graze
    assert_allclose(t, 2.0, rtol=0, atol=1e-6)
    assert_allclose(x, -5.0, rtol=0, atol=1e-6)
    assert np.isinf(d_t)
    assert not np.isnan(d_x)


class Between(jf.System):
    """A ball between a floor and a ceiling at 1."""

    g: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.g])

    def switching(self, t, x):
        return jnp.stack([x[0], 1.0 - x[0]])

    def reset(self, t, x, surface):
        return x.at[1].multiply(-1.0)


@pytest.mark.slow
def test_a_graze_leaves_the_gradient_of_earlier_contacts():
    """Thrown down from 1/2, it touches the ceiling at the top of its flight after the impact."""

    def first(p):
        run = dict(stepper=jf.RK4(), max_events=8, compact=True)
        events = jf.solve(Between(p[2]), p[:2], 0.0, 2.5, 0.125, **run).events
        return events.ts[0], events.kinds[1]

    p = jnp.asarray([0.5, -1.0, 1.0])
    (t, kind), slope = jax.jit(jax.value_and_grad(first, has_aux=True))(p)
    assert kind == EventKind.graze
    # t = (v + s)/g with s = √(v² + 2 g y), downward: by y, v, g.
    s = np.sqrt(2.0)
    assert_allclose(t, s - 1, rtol=1e-14)
    assert_allclose(slope, [1 / s, 1 - 1 / s, 0.5 / s - (s - 1)], rtol=1e-13)
