"""Levels and voltages that stand still exactly on their surface, while something else happens."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf


class Hours(jf.System):
    """Level, valve, hours. The inlet closes at the level 1; a clock counts hours."""

    clocks = (jf.Clock(1.0, 0.5),)

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.where(x[1] > 0.5, 1.0, 0.0), 0.0, 0.0])

    def switching(self, t, x):
        return 1 - x[0]

    def reset(self, t, x, surface):
        return x.at[1].set(0.0)

    def tick(self, t, x, clock):
        return x.at[2].add(1.0)


class TwoTanks(jf.System):
    """Two levels and two valves."""

    def vector_field(self, t, x, side):
        flows = jnp.where(x[2:] > 0.5, jnp.array([1.0, 0.5]), 0.0)
        return jnp.concatenate([flows, jnp.zeros(2)])

    def switching(self, t, x):
        return 1 - x[:2]

    def reset(self, t, x, surface):
        return x.at[2 + surface].set(0.0)


class Counting(jf.System):
    """Two voltages that stand still between kicks of 5 and 4, and their numbers of spikes. At 15
    they fire and lose 15."""

    clocks = (jf.Clock(1.0),)

    def vector_field(self, t, x, side):
        return 0 * x

    def switching(self, t, x):
        return 15 - x[:2]

    def reset(self, t, x, surface):
        return x.at[surface].add(-15.0).at[2 + surface].add(1.0)

    def tick(self, t, x, clock):
        return x + jnp.array([5.0, 4.0, 0.0, 0.0])


class CountingInteger(Counting):
    slides: ClassVar[bool] = False


class Opened(Hours):
    """The inlet is opened again by the tick at 1.5, while the level stands at 1: it is over the
    threshold then, and the valve closes at once."""

    def tick(self, t, x, clock):
        return x.at[1].set(jnp.where(t > 1, 1.0, x[1])).at[2].add(1.0)


@pytest.mark.parametrize(
    ("system", "t0", "x0", "t1", "end"),
    [
        (Hours(), 0.0, [0.0, 1.0, 0.0], 3.0, [1, 0, 3]),
        (Hours(), 1.0, [1.0, 0.0, 1.0], 3.0, [1, 0, 3]),  # from where it stands
        (TwoTanks(), 0.0, [0.0, 0.0, 1.0, 1.0], 3.0, [1, 1, 0, 0]),
        (Counting(), 0.0, [0.0] * 4, 4.5, [5, 1, 1, 1]),
        (CountingInteger(), 0.0, [0.0] * 4, 4.5, [5, 1, 1, 1]),
        (Opened(), 0.0, [0.0, 1.0, 0.0], 2.0, [1, 0, 2]),
    ],
)
@pytest.mark.slow
def test_what_stands_still_on_its_surface_stays_there(system, t0, x0, t1, end):
    sol = jf.solve(system, jnp.array(x0), t0, t1, 0.07)
    np.testing.assert_allclose(sol.x_final, end, rtol=0, atol=1e-13)


class Static(jf.System):
    """Position, velocity, and whether the mass sticks; a static friction above the kinetic one, and
    a force of r t. A release and a stop are resets, and whether it stops compares the force with
    what it has just exceeded."""

    static: jax.Array
    rate: jax.Array
    slides: ClassVar[bool] = False

    def force(self, t, x):
        return self.rate * t - x[0]

    def vector_field(self, t, x, side):
        slips = jnp.stack([x[1], self.force(t, x) - 0.6 * side[0], 0.0])
        return jnp.where(x[2] > 0.5, jnp.zeros(3), slips)

    def switching(self, t, x):
        spare = self.static - jnp.abs(self.force(t, x))
        sticks = x[2] > 0.5
        return jnp.stack([jnp.where(sticks, 1.0, x[1]), jnp.where(sticks, spare, 1.0)])

    def reset(self, t, x, surface):
        caught = jnp.abs(self.force(t, x)) < self.static
        stuck = jnp.where(caught, jnp.stack([x[0], 0.0, 1.0]), x)
        return jnp.where(surface == 0, stuck, x.at[2].set(0.0))


@jax.jit
@jax.vmap
def pulled(static, rate):
    start = jnp.array([0.0, 0.0, 1.0])
    sol = jf.solve(Static(static, rate), start, 0.0, 30.0, 0.25, throw=False, max_events=16)
    return sol.result, sol.x_final, sol.events.ts


@pytest.mark.release
def test_a_comparison_at_its_equality_is_not_left_to_rounding():
    statics, rates = np.tile(np.linspace(0.9, 1.1, 8), 2), np.repeat([0.05, -0.05], 8)
    _, ends, times = pulled(statics, rates)
    # After a time τ of slip x = (s − k)(1 − cos τ) + r (τ − sin τ); it stops where x' is zero.
    starts = statics / 0.05
    lasts = 2 * (np.pi + np.arctan((0.6 - statics) / 0.05))
    moved = (statics - 0.6) * (1 - np.cos(lasts)) + 0.05 * (lasts - np.sin(lasts))
    exact = np.stack([np.sign(rates) * moved, 0 * moved, 1 + 0 * moved], axis=1)
    np.testing.assert_allclose(ends, exact, rtol=0, atol=1e-8)
    for row, start, last in zip(np.asarray(times), starts, lasts, strict=True):
        found = np.unique(np.round(row[np.isfinite(row)], 9))
        np.testing.assert_allclose(found, [start, start + last], rtol=0, atol=1e-8)
