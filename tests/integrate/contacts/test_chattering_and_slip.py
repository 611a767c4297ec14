"""Impacts that die out while each of them makes something else slip and stick again.

A mass falls by 1/2, g = 1 and e = 4/5, on an equal one that dry friction 3 holds: a speed u before
an impact becomes √0.28 u before the next one. In between the lower one slips for 0.3 u by 0.135 u²,
and the flight lasts (√0.28 − 0.1) u. Sums of geometric series say the rest.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Pile(jf.System):
    """The lower mass (x, v), and the one (y, w) that falls on it."""

    friction: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.friction * side[0], x[3], -1.0])

    def switching(self, t, x):
        return jnp.stack([x[1], x[2] - x[0]])

    def reset(self, t, x, surface):
        push = 0.9 * (x[3] - x[1])
        met = jnp.stack([x[0], x[1] + push, x[2], x[3] - push])
        return jnp.where(surface == 1, met, x)


@eqx.filter_jit
def solve(friction):
    x0 = jnp.array([1.0, 0.0, 1.5, 0.0])
    return jf.solve(Pile(friction), x0, 0.0, 4.0, 0.1, max_events=200, throw=False, compact=True)


@pytest.mark.release
def test_a_mass_comes_to_rest_on_one_that_each_impact_makes_slip():
    sol = solve(jnp.asarray(3.0))
    assert str(outcome_names(sol.result)) == "successful"
    np.testing.assert_array_equal(sol.mode_final, [0, 2])
    low, ends = 1 - 0.135 / 0.72, 1 + (np.sqrt(0.28) - 0.1) / (1 - np.sqrt(0.28))
    np.testing.assert_allclose(sol.x_final, [low, 0, low, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(sol.events.ts[sol.num_events - 1], ends, rtol=0, atol=1e-8)
