"""Kinks and jumps that no surface declares, located on the polynomial of a Taylor step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

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
