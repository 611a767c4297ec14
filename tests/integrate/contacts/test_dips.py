"""A graze is found wherever in a step its top lies: a mass that swings against a wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from tests.results import outcome_names


class Wall(jf.System):
    """x'' = −ω²x below a wall at x = 1 − depth, with restitution 1/2."""

    omega: jax.Array
    wall: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -(self.omega**2) * x[0]])

    def switching(self, t, x):
        return self.wall - x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.5 * x[1]])


OFFSETS = np.concatenate([np.linspace(5e-4, 0.02, 12), np.linspace(0.05, 0.95, 11)])
THETAS = np.concatenate([OFFSETS, 1 - OFFSETS[:12]])
# What the steps before have missed of the top is less.
DEPTHS = np.array([1e-5, 1e-7, 1e-9, 1e-11])


@pytest.mark.slow
@pytest.mark.parametrize("omega, dt", [(1.0, 0.1), (3.0, 0.05), (1.0, 0.02)])
def test_dips_near_the_ends_of_steps(omega, dt):
    theta, depth = (v.ravel() for v in np.meshgrid(THETAS, DEPTHS))
    top = (4 + theta) * dt
    t1 = top.max() + 1 / omega
    x0 = np.stack([np.cos(-omega * top), -omega * np.sin(-omega * top)], axis=1)

    @jax.jit
    @jax.vmap
    def run(wall, x0):
        system, options = Wall(jnp.asarray(omega), wall), dict(compact=True, max_events=8)
        sol = jf.solve(system, x0, 0.0, t1, dt, throw=False, **options)
        return sol.result, sol.x_final, sol.num_events

    results, ends, counts = run(jnp.asarray(1 - depth), jnp.asarray(x0))
    assert set(outcome_names(results)) == {"successful"}
    np.testing.assert_array_equal(counts, 1)
    met = top - np.arccos(1 - depth) / omega
    speed = -0.5 * omega * np.sqrt(2 * depth - depth**2)
    turn = omega * (t1 - met)
    x = (1 - depth) * np.cos(turn) + speed / omega * np.sin(turn)
    v = -omega * (1 - depth) * np.sin(turn) + speed * np.cos(turn)
    # An error δ of the top is one of √δ at the end.
    error = np.abs(ends - np.stack([x, v], axis=1)).max(axis=1)
    assert (error < 0.05 * omega * np.sqrt(2 * depth)).all()
