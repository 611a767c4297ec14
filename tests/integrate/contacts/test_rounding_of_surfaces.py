"""Surfaces whose H is made of large terms that cancel: phases and offsets change no motion."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

import jaxfil as jf
from jaxfil import RESULTS

# Phases that are periods of the sine, and heights of the origin.
SHIFTS = [(0, 0.0), (1000, 0.0), (10_000, 0.0), (10**6, 0.0), (0, 1e3), (0, 1e6)]


class ShakenTable(jf.System):
    """A ball falls with a gravity of 1 on a table at 0.2 sin(t + φ), both of them L above zero."""

    restitution: jax.Array
    phase: jax.Array
    height: jax.Array
    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return (x[0] + self.height) - (self.height + 0.2 * jnp.sin(t + self.phase))

    def reset(self, t, x, surface):
        table = 0.2 * jnp.cos(t + self.phase)
        return jnp.stack([x[0], table - self.restitution * (x[1] - table)])


@jax.jit
def bounced(restitutions, phase, height, starts):
    """Outcomes, times and states at the end of runs on a table, to t = 6."""

    def end(e, x0):
        table = ShakenTable(e, phase, height)
        sol = jf.solve(table, x0, 0.0, 6.0, 0.05, throw=False, compact=True)
        return sol.result, sol.t_final, sol.x_final

    return jax.vmap(end)(restitutions, starts)


def flights(restitution, x, v, t1):
    """The end of the motion by parabolas, the first zero of each found on a fine grid; None if
    flights become short."""
    t = 0.0
    while True:
        gap = lambda s, t=t, x=x, v=v: x + v * s - s * s / 2 - 0.2 * np.sin(t + s)  # noqa: E731
        grid = np.linspace(1e-9, t1 - t, 20_001)
        below = np.flatnonzero(gap(grid) < 0)
        if not below.size:
            s = t1 - t
            return x + v * s - s * s / 2, v - s
        (i, *_) = below
        s = brentq(gap, grid[i - 1], grid[i], xtol=1e-15) if i else 0.0
        if s < 0.05:
            return None
        t, x, v = t + s, x + v * s - s * s / 2, v - s
        table = 0.2 * np.cos(t)
        v = table - restitution * (v - table)


@pytest.mark.slow
@pytest.mark.parametrize("number, height", SHIFTS)
def test_a_ball_on_a_shaken_table_does_not_fall_through_it(number, height):
    draw, t1 = np.random.default_rng(0), 6.0
    starts = np.stack([abs(draw.normal(size=60)) + 0.4, draw.normal(size=60)], axis=1)
    restitutions, phase = draw.uniform(0.2, 0.8, 60), 2 * np.pi * number
    results, _, ends = bounced(restitutions, phase, height, starts)
    assert (results == RESULTS.successful).all()
    assert (ends[:, 0] > 0.2 * np.sin(t1) - 1e-6).all()
    known = [flights(e, *x0, t1) for e, x0 in zip(restitutions, starts, strict=True)]
    some = np.array([v is not None for v in known])
    assert some.sum() > 10
    # Rounding of H moves a contact by its part of the speed there, and impacts pass it on.
    rounding = np.finfo(float).eps * max(1.0, phase, height)
    exact = np.array([v for v in known if v is not None])
    assert_allclose(ends[some], exact, rtol=0, atol=1e4 * rounding + 1e-9)


class ShakenBelt(jf.System):
    """A mass on a spring, on a belt whose speed is 0.5 + 0.3 sin(t + φ), seen from a frame that
    moves with a speed of −L."""

    phase: jax.Array
    frame: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - 0.6 * side])

    def switching(self, t, x):
        return (x[1] + self.frame) - (self.frame + 0.5 + 0.3 * jnp.sin(t + self.phase))


def test_a_mass_sticks_to_a_shaken_belt_whatever_its_phase():
    @jax.jit
    @jax.vmap
    def run(phase, frame):
        sol = jf.solve(
            ShakenBelt(phase, frame), jnp.array([0.3, 0.1]), 0.0, 20.0, 0.05, throw=False
        )
        return sol.result, sol.num_events, sol.x_final

    numbers, frames = np.array(SHIFTS).T
    results, counts, ends = run(jnp.asarray(2 * np.pi * numbers), jnp.asarray(frames))
    assert (results == RESULTS.successful).all()
    assert_array_equal(counts, counts[0])
    rounding = np.finfo(float).eps * np.maximum(1.0, np.maximum(2 * np.pi * numbers, frames))
    assert (abs(ends - ends[0]).max(axis=1) <= 1e4 * rounding + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 100])
def test_in_single_precision_the_ball_stays_above_the_table(number):
    e, phase = np.linspace(0.3, 0.7, 16), 2 * np.pi * number
    starts = np.broadcast_to([1.0, 0.0], (16, 2))
    single = (np.asarray(v, np.float32) for v in (e, phase, 0.0, starts))
    results, times, ends = bounced(*single)
    heights = ends[:, 0]
    assert (heights > 0.2 * np.sin(times) - 1e-3).all()
    # A phase of 600 is known to 3e-5: with it a run may be given up where the ball comes to rest.
    assert (results == RESULTS.successful).sum() >= (16 if number == 3 else 12)


def test_a_slip_that_rounding_leaves_on_the_wrong_side_is_met_again():
    """In float32 the mass slips 6e-6 beyond the speed of the belt, which two bounds of rounding
    told apart: steps crept on by 1e-6."""
    numbers = {"mu": 0.6, "alpha": -0.05, "beta": 0.0, "g": 9.81, "f0": 10.0, "v": 1.0}
    belt = jf.systems.BeltFriction(gamma1=0.0, gamma2=1e4, omega=4.378442, **numbers)
    single = jax.tree.map(np.float32, belt)
    period = np.float32(2 * np.pi / 4.378442)
    x0 = jnp.zeros(2, jnp.float32)
    sol = jf.solve(single, x0, np.float32(0), 2 * period, period / 25, throw=False)
    assert sol.result == RESULTS.successful
    assert sol.stats["num_iterations"] < 200
    exact = jf.solve(belt, jnp.zeros(2), 0.0, float(2 * period), float(period) / 25)
    assert_allclose(sol.x_final, exact.x_final, rtol=0, atol=1e-4)
