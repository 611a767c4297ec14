"""Numbers at the ends of their range: gaps, scales, times and contacts far outside the usual."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil import RESULTS
from tests.integrate.run.test_solve import Scaled
from tests.oracles.extreme_systems import Circle


def test_grazing_within_1e_14():
    """|x| = 1 misses the line, or crosses it and never comes back to that circle."""
    gaps = (1 + jnp.asarray([1e-12, 1e-14, -1e-14, -1e-12])) - 1

    @jax.jit
    @jax.vmap
    def end(gap):
        x0 = jnp.asarray([1.0, 0.0])
        sol = jf.solve(Circle(gap), x0, 0.0, np.pi / 2 + 1, 0.04, throw=False)
        return sol.result, sol.num_events, sol.xs[-1]

    results, counts, xs = end(gaps)
    assert (results == RESULTS.successful).all()
    assert_array_equal(counts, [0, 0, 1, 1])
    assert_allclose(
        xs[:2], [[np.cos(np.pi / 2 + 1), np.sin(np.pi / 2 + 1)]] * 2, rtol=0, atol=1e-14
    )
    for gap, x in zip(np.asarray(gaps[2:]), xs[2:], strict=True):
        # It crosses at x₁ = half, where rounding of x₂ shifts it by eps/half.
        half = np.sqrt(-gap * (2 + gap))
        left, a, b = 1 + np.arcsin(half), half + 1, 1 + gap
        want = [a * np.cos(left) - b * np.sin(left) - 1, a * np.sin(left) + b * np.cos(left)]
        assert_allclose(x, want, rtol=0, atol=16 * np.finfo(float).eps / half)


COULOMB = [0.4 + np.cos(7 - 2 * np.pi), -np.sin(7 - 2 * np.pi)]  # at t = 7, from (3, 0)


@pytest.fixture(scope="module")
def coulomb():
    """From (3, 0)·state at t0 to t0 + 7, with a traced step: outcome, state at the end."""

    @jax.jit
    @jax.vmap
    def end(state, t0):
        one = jnp.ones_like(state)
        system = Scaled(jf.systems.CoulombOscillator(), one, state * jnp.ones(2), state)
        x0 = state * jnp.asarray([3.0, 0.0])
        dt = 0.05 * one
        sol = jf.solve(system, x0, t0, t0 + 7, dt, max_events=8, throw=False)
        return sol.result, sol.x_final / state

    return lambda *lanes: end(*(jnp.broadcast_to(jnp.asarray(v, float), 8) for v in lanes))


def test_states_too_small_or_too_large_are_told_or_right(coulomb):
    """Products of guards and rates over- or underflow: that is no success."""
    scales = [1.0, 1e-140, 1e140, 1e-290, 1e-310, 1e160, 1e290, 1e307]
    results, xs = coulomb(jnp.asarray(scales), 0.0)
    good = np.asarray(results == RESULTS.successful)
    assert good[:3].all()
    assert_allclose(xs[good], np.broadcast_to(COULOMB, (good.sum(), 2)), rtol=1e-9)


def test_huge_t0(coulomb):
    """Elapsed times are as good as ever, until a step cannot be told from none."""
    results, xs = coulomb(1.0, jnp.asarray([0.0, 1e3, 1e6, 1e9, 1e12, 1e15, 1e16, 1e18]))
    assert_array_equal(results == RESULTS.successful, [True] * 5 + [False] * 3)
    assert_array_equal(results == RESULTS.nonfinite, [False] * 5 + [True] * 3)
    assert_allclose(xs[:5], [COULOMB] * 5, rtol=1e-12)
    with pytest.raises(ValueError, match=r"`dt` must be greater than 1\.8, the rounding of times"):
        jf.solve(jf.systems.CoulombOscillator(), jnp.ones(2), 1e15, 1e15 + 7, 0.05)


def test_broken_lanes_leave_no_trace_in_others(coulomb):
    _, clean = coulomb(jnp.linspace(1.0, 2.0, 8), 0.0)
    broken = jnp.linspace(1.0, 2.0, 8).at[jnp.asarray([2, 5])].set(jnp.asarray([jnp.nan, jnp.inf]))
    results, xs = coulomb(broken, jnp.zeros(8).at[7].set(jnp.nan))
    fine = np.asarray([0, 1, 3, 4, 6])
    assert_array_equal(np.flatnonzero(results == RESULTS.successful), fine)
    assert_array_equal(xs[fine], clean[fine])


def test_subnormal_state():
    """The two-fold of the SD oscillator at the origin, missed by 1e-310: zero to the processor."""
    x0 = jnp.asarray([1e-310, 0.0])
    sol = jf.solve(jf.systems.SDOscillator(), x0, 0.0, 3.0, 0.1, throw=False)
    right = sol.result == RESULTS.successful and sol.xs[-1, 0] > 1
    assert right or sol.result == RESULTS.nonunique


def test_fifty_contacts_in_a_step():
    """x'' = −1030 sgn x from (0, 1): parabolas of length 2/1030."""
    pull = 1030.0
    relay = jf.piecewise(
        lambda t, x: jnp.stack([x[1], jnp.full_like(t, -pull)]),
        lambda t, x: jnp.stack([x[1], jnp.full_like(t, pull)]),
        lambda t, x: x[0],
    )
    sol = jf.solve(relay, jnp.asarray([0.0, 1.0]), 0.0, 0.1, 0.1)
    assert sol.num_events == 51
    since = 0.1 - 51 * 2 / pull
    want = [-(since - pull * since**2 / 2), -(1 - pull * since)]
    assert_allclose(sol.xs[-1], want, rtol=0, atol=1e-10)
    assert_allclose(sol.events.ts[:51], np.arange(1, 52) * 2 / pull, rtol=1e-12)
