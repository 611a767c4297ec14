"""Kinks and jumps that no surface declares, located on the polynomial of a Taylor step."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

import jaxfil as jf

FINE = jf.Adaptive(1e-10, 1e-12)
PLACES, FORCES = np.arange(9) / 4, np.array([-1.0, 0, 1, 0, -1, 0, 1, 0, -1])


def by_table(q):
    i = (4 * q).astype(int)
    forces, last = jnp.asarray(FORCES), i.astype(float)
    return forces[i] + (4 * q - last) * (forces[i + 1] - forces[i])


def by_sign(q):
    right, left = q - 1, 0.5 - q
    return -4 * (q - 0.75) + 4 * (1 + jnp.sign(right)) * right - 4 * (1 + jnp.sign(left)) * left


# A triangle wave of period 1, 1 at 1/2 and −1 at 1, as a program may have it.
WAVES = {
    "mod": lambda q: 1 - 4 * jnp.abs(jnp.mod(q, 1.0) - 0.5),
    "remainder": lambda q: 1 - jnp.abs(jnp.fmod(4 * q, 4.0) - 2),
    "round": lambda q: 4 * jnp.abs(q - jnp.round(q)) - 1,
    "floor": lambda q: 1 - 4 * jnp.abs(q - jnp.floor(q) - 0.5),
    "ceil": lambda q: 1 - 4 * jnp.abs(q - jnp.ceil(q) + 0.5),
    "sign": by_sign,
    "whole numbers": by_table,
    "interp": lambda q: jnp.interp(q, PLACES, FORCES),
}


class Motor(jf.System):
    """The cogging torque of a stepper motor."""

    wave: str = eqx.field(static=True)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], WAVES[self.wave](x[0])])


def half_turn(speed):
    """The time from q = 3/4 back to it: a sine up to q = 1, and a hyperbolic one from there."""
    left = np.sqrt(speed**2 - 0.25)
    return np.arcsin(0.5 / speed) + np.arctanh(2 * left)


@pytest.mark.parametrize(
    "wave",
    [v if v in ("mod", "interp") else pytest.param(v, marks=pytest.mark.slow) for v in WAVES],
)
def test_a_kink_is_located_however_it_is_written(wave):
    speeds = np.array([0.503, 0.52, 0.6, 0.65])

    @jax.jit
    @jax.vmap
    def end(speed, t1):
        x0 = jnp.stack([0.75, speed])
        return jf.solve(Motor(wave), x0, 0.0, t1, FINE, stepper=jf.Taylor()).x_final

    found = end(speeds, 3 * half_turn(speeds))
    assert_allclose(found, np.stack([np.full(4, 0.75), -speeds], axis=1), rtol=0, atol=2e-8)


class Nearest(jf.System):
    """A pull by the nearest of three wells."""

    def vector_field(self, t, x, side):
        wells = jnp.array([-1.0, 0.2, 1.0])
        return jnp.stack([x[1], wells[jnp.argmin(abs(x[0] - wells))] - x[0]])


def test_a_jump_that_cannot_be_located_is_refused_by_name():
    x0 = jnp.array([0.3, 0.0])
    with pytest.raises(ValueError, match=r"jaxfil.Taylor\(\) with a tolerance.*`argmin`"):
        jf.solve(Nearest(), x0, 0.0, 1.0, FINE, stepper=jf.Taylor())
    # Within one well, with fixed steps.
    sol = jf.solve(Nearest(), x0, 0.0, 1.0, 0.1, stepper=jf.Taylor())
    assert_allclose(sol.x_final[0], 0.2 + 0.1 * np.cos(1.0), rtol=1e-13)


class Onset(jf.System):
    """A force from an unknown time on, and a speed that drops from 2 to 1 at x = 1."""

    at: jax.Array

    def vector_field(self, t, x, side):
        speed = jnp.where(x[1] > 1.0, -2.0, -1.0)
        return jnp.stack([jnp.maximum(t - self.at, 0.0), speed])


class Stiffening(jf.System):
    """x' = −x − max(x − 1, 0)."""

    def vector_field(self, t, x, side):
        return -x - jnp.maximum(x - 1.0, 0.0)


def test_the_time_of_a_kink_has_its_derivatives():
    # (t1 − p)²/2, and 1 − (t1 − (x0 − 1)/2) behind the jump.
    def end(v):
        x0 = jnp.stack([0.0 * v[0], v[1]])
        return jf.solve(Onset(v[0]), x0, 0.0, 2.0, FINE, stepper=jf.Taylor()).x_final

    @jax.jit
    def both(v):
        return jax.jacfwd(end)(v), jax.jacfwd(jax.jacfwd(end))(v)

    first, second = both(jnp.array([0.7, 2.0]))
    assert_allclose(first, [[-1.3, 0.0], [0.0, 0.5]], rtol=0, atol=1e-10)
    curved = np.zeros((2, 2, 2))
    curved[0, 0, 0] = 1.0
    assert_allclose(second, curved, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_derivatives_through_a_kink_of_the_state_in_both_modes():
    # e^(−t) √(2 x0 − 1) behind the kink.
    def end(x0, **options):
        x0 = jnp.stack([x0])
        return jf.solve(Stiffening(), x0, 0.0, 2.0, FINE, stepper=jf.Taylor(), **options).x_final[0]

    root, decay, at = np.sqrt(3.0), np.exp(-2.0), jnp.array(2.0)
    second = jax.jit(jax.jacfwd(jax.jacfwd(end)))(at)
    assert_allclose(second, -decay / root**3, rtol=1e-10)
    back = {"adjoint": diffrax.RecursiveCheckpointAdjoint()}
    first = jax.jit(jax.grad(lambda x0: end(x0, **back)))(at)
    assert_allclose(first, decay / root, rtol=1e-10)


class Chute(jf.System):
    """x'' = 5.2, and a drag of 0.8 x' where |x| > 1."""

    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 5.2 - 0.4 * (1 + side) * x[1]])

    def switching(self, t, x):
        return abs(x[0]) - 1.0


def test_a_surface_with_a_kink_is_not_missed_in_a_long_step():
    @jax.jit
    @jax.vmap
    def end(x0):
        sol = jf.solve(Chute(), x0, 0.0, 1.5, 1.5, stepper=jf.Taylor(30), max_events=8)
        return sol.x_final, sol.num_events

    # One passes x = −1 and comes back within the step, one turns before.
    found, events = end(jnp.array([[0.5, -4.0], [0.5, -3.9]]))
    # Below −1: x' = u + (v − u) e^(−0.8 s) with u = 6.5, from a speed of √(16 − 10.4 · 1.5).
    v, u = -np.sqrt(16 - 10.4 * 1.5), 5.2 / 0.8

    def depth(s):
        return u * s + (v - u) * (1 - np.exp(-0.8 * s)) / 0.8

    stay = float(brentq(depth, 0.01, 1.0, xtol=1e-15))  # pyright: ignore[reportArgumentType]
    back = u + (v - u) * np.exp(-0.8 * stay)
    rest = 1.5 - (4 + v) / 5.2 - stay
    exact = [[-1 + back * rest + 2.6 * rest**2, back + 5.2 * rest], [0.5, 3.9]]
    assert_array_equal(events, [2, 0])
    assert_allclose(found, exact, rtol=0, atol=1e-12)
