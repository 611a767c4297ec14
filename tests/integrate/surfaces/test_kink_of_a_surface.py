"""A kink of a switching function, declared as a surface of its own: time-optimal control of the
double integrator.

x'' = −sgn(x + x'|x'|/2) slides along its switching curve, itself a motion with full control, to the
origin, where it rests. From a state with H > 0 it arrives after v + 2 √(x + v²/2); the other side
is its mirror image (Pontryagin and others, The Mathematical Theory of Optimal Processes, 1962).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.results import assert_within, outcome_names

EPS = np.finfo(float).eps


class Fastest(jf.System):
    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side[0]])

    def switching(self, t, x):
        return jnp.stack([x[0] + x[1] * jnp.abs(x[1]) / 2, x[1]])


def by_hand(x):
    s = jnp.sign(x[0] + x[1] * jnp.abs(x[1]) / 2)
    return s * x[1] + 2 * jnp.sqrt(s * x[0] + x[1] ** 2 / 2)


@pytest.mark.release
def test_it_rests_at_the_origin_from_everywhere():
    """Also its gradient is exact, which diverges as 1/√ towards the curve, hence the bound."""

    def arrival(x):
        options = dict(max_events=6, throw=False, compact=True)
        sol = jf.solve(Fastest(), x, 0.0, 12.0, 0.1, **options)
        return sol.events.ts[sol.num_events - 1], sol

    starts = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (32, 2)))
    found = jax.jit(jax.vmap(jax.value_and_grad(arrival, has_aux=True)))(starts)
    (times, sols), gradients = found
    assert set(outcome_names(sols.result)) == {"successful"}
    assert_within(times, jax.vmap(by_hand)(starts), 64 * EPS)
    assert_within(sols.x_final, np.zeros((32, 2)), EPS)
    curved = np.abs(jax.vmap(jax.hessian(by_hand))(starts)).max()
    assert_within(gradients, jax.vmap(jax.grad(by_hand))(starts), 64 * EPS * (1 + curved) ** 2)


class Relay(jf.System):
    """x'' = −sgn x, with x' as a second surface."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side[0]])

    def switching(self, t, x):
        return x


@pytest.mark.slow
def test_a_relay_on_a_position_stays_at_rest():
    """There H and its rate both vanish, whatever the side."""
    sol = jf.solve(Relay(), jnp.zeros(2), 0.0, 2.0, 0.1, compact=True, max_events=4)
    assert sol.num_events == 0
    assert_within(sol.x_final, np.zeros(2), 0.0)
