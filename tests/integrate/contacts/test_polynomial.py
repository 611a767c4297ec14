"""First zeros of polynomials, against all their roots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf
from jaxfil.integrate.contacts.cubic import NEVER
from jaxfil.integrate.contacts.polynomial import first_zero, stays_positive
from jaxfil.integrate.system.lowered import build

NOISE = 1e-14
SYSTEM = build(jf.systems.CoulombOscillator(), jnp.zeros(2), compact=False)


@jax.jit
def zeros(coefficients):
    """θ, what is to be looked at, and whether both are known; of coefficients (lanes, p + 1)."""
    noise = jnp.asarray(NOISE)
    found = jax.vmap(lambda c: first_zero(SYSTEM, noise, *c))(coefficients)
    return found, jax.vmap(lambda c: stays_positive(tuple(c), noise))(coefficients)


def first_root(c):
    """The first root in (0, 1] at which the polynomial falls below zero; inf: none."""
    roots = np.roots(c[::-1])
    real = np.sort(roots[abs(roots.imag) < 1e-9 * (1 + abs(roots))].real)
    inside = real[(real > 1e-9) & (real <= 1)]
    falls = [r for r in inside if np.polyval(np.polyder(c[::-1]), r) < 0]
    return falls[0] if falls else np.inf


def random_polynomials(count, start):
    """Polynomials as guards of steps that resolve the motion: with falling coefficients; positive
    at 0, or zero there, once or twice."""
    generator = np.random.default_rng(7)
    c = generator.normal(size=(count, 13)) * 0.5 ** np.arange(13)
    c[:, 0] = abs(c[:, 0]) * generator.choice([1.0, 1e-3], count)
    if start > 0:
        c[:, 0], c[:, 1] = 0.0, abs(c[:, 1])
    if start > 1:
        c[:, 1], c[:, 2] = 0.0, abs(c[:, 2])
    return c


@pytest.mark.parametrize("start", [0, 1, 2])
def test_the_first_zero_is_found(start):
    c = random_polynomials(512, start)
    found, clear = zeros(jnp.asarray(c))
    theta, look, known = map(np.asarray, found)
    exact = np.array([first_root(row) for row in c])
    assert np.all(known == 1)
    crosses = theta < NEVER
    lanes = list(zip(c[:, ::-1], np.minimum(theta, 1), strict=True))
    slope = np.array([np.polyval(np.polyder(row), s) for row, s in lanes])
    error = np.array([np.polyval(row, s) for row, s in lanes])
    # Newton's last iteration leaves rounding of the terms.
    assert np.all(abs(error[crosses]) < 64 * np.finfo(float).eps * abs(c[crosses]).sum(1))
    assert np.all(slope[crosses] < 0)
    # The first one, where the whole step was searched; else the search has ended before it.
    whole = look == NEVER
    assert_allclose(theta[crosses & whole], exact[crosses & whole], rtol=1e-6)
    assert np.all(np.isinf(exact[whole & ~crosses]))
    assert np.all(exact[~whole] > look[~whole] * (1 - 1e-9))
    assert np.all(np.isinf(exact[np.asarray(clear)]))
    assert np.mean(clear) > 0.3 and np.sum(crosses) > 50


def test_a_touch_is_looked_at_and_a_dip_is_met():
    s, p = 0.37, np.zeros((3, 13))
    for row, depth in enumerate((0.0, -1e-9, 1e-9)):
        p[row, :3] = s * s + depth, -2 * s, 1.0
    (theta, look, known), _ = zeros(jnp.asarray(p))
    theta, look = np.asarray(theta), np.asarray(look)
    assert np.all(np.asarray(known) == 1)
    assert_allclose(look[0], s, atol=1e-7)
    assert theta[0] == NEVER
    assert_allclose(theta[1], s - np.sqrt(1e-9), rtol=1e-9)
    assert theta[2] == NEVER and look[2] == NEVER


def test_what_is_rounding_has_no_zero():
    c = np.full((1, 13), 1e-17) * (-1.0) ** np.arange(13)
    (theta, look, known), _ = zeros(jnp.asarray(c))
    assert theta[0] == NEVER and look[0] == NEVER and known[0] == 1
