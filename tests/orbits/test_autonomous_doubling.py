"""A branch through the period doubling of an autonomous orbit: Rössler's, by SciPy's shooting.

The numbers are those of `fsolve` on the variational equations by DOP853 with rtol = 1e-13, which
closes to 1e-14, and `brentq` for the multiplier of −1.
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf

DOUBLING = 2.8324450278624167
PERIOD_THERE = 5.76982002
PERIOD_AT_3 = 11.531074139878834
MULTIPLIER_AT_3 = 0.58629782


class Roessler(jf.System):
    """x' = −y − z, y' = x + y/5, z' = 1/5 + z (x − c)."""

    c: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([-x[1] - x[2], x[0] + 0.2 * x[1], 0.2 + x[2] * (x[0] - self.c)])


@ft.cache
def doublings():
    system = Roessler(jnp.asarray(2.8))
    guess = jnp.array([5.05733925, 0.0, 1.62755546])
    orbit = jf.periodic_orbit(system, guess, period=5.768, steps=120)
    branch = jf.continue_orbit(system, "c", orbit, stop=2.85)
    return system, [point for point in branch.points if point.kind == "period-doubling"]


@pytest.mark.slow
def test_an_autonomous_period_doubling_is_where_scipy_finds_it():
    _, (point,) = doublings()
    assert_allclose(point.value, DOUBLING, rtol=0, atol=1e-9)
    assert_allclose(point.orbit.period, PERIOD_THERE, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_the_branch_of_doubled_period_is_that_of_scipy():
    system, (point,) = doublings()
    doubled = jf.continue_orbit(system, "c", point, stop=3.0, max_step=0.05)
    assert_allclose(doubled.orbits.period[0], 2 * PERIOD_THERE, rtol=1e-3)
    (orbit,) = doubled.at(3.0)
    assert_allclose(orbit.period, PERIOD_AT_3, rtol=0, atol=1e-8)
    nearest = np.argmin(abs(orbit.multipliers - MULTIPLIER_AT_3))
    assert_allclose(orbit.multipliers[nearest], MULTIPLIER_AT_3, rtol=0, atol=1e-7)
    assert bool(orbit.stable)
