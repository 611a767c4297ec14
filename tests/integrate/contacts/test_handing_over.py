"""Where dry friction takes over from a reaction."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf


class Pressed(jf.System):
    """A mass (q, v) that a force t − 4 presses on a floor at q = 0, with dry friction μ: from
    t = 4 − μ on friction holds it, without the floor, and at t = 4 + μ it lifts off."""

    friction: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], t - 4 - self.friction * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[1], x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, jnp.stack([x[0], 0 * x[1]]), x)


@eqx.filter_jit
def pressed(friction):
    def run(friction):
        sol = jf.solve(
            Pressed(friction), jnp.array([0.5, 0.0]), 0.0, 7.0, 0.1, max_events=16, compact=True
        )
        return sol.x_final, sol.events

    def one(friction):
        slope = jax.jvp(lambda mu: run(mu)[0][0], (friction,), (jnp.ones_like(friction),))[1]
        return *run(friction), slope

    return jax.vmap(one)(friction)


@pytest.mark.release
def test_friction_takes_over_from_a_reaction_at_the_time_when_that_ends():
    """Not a nanosecond later, by the contact of a motion that the floor does not allow."""
    mu = np.array([0.7, 1.0, 1.5])
    x, events, slope = pressed(jnp.asarray(mu))
    np.testing.assert_allclose(x[:, 0], (3 - mu) ** 3 / 6, rtol=1e-12)
    np.testing.assert_allclose(slope, -((3 - mu) ** 2) / 2, rtol=1e-11)
    times = np.asarray(events.ts)[:, 1:4]
    expected = np.stack([4 - mu, 4 - mu, 4 + mu], axis=1)
    np.testing.assert_allclose(times, expected, rtol=0, atol=1e-12)
    assert not np.isfinite(np.asarray(events.ts)[:, 4:]).any()
