"""Orbits that meet a surface where they are closed: that contact counts once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf


class Relay(jf.System):
    """x'' + x + k sgn x = A sin 2t, whose odd orbit crosses the surface at 0 and T/2."""

    a: jax.Array
    k: jax.Array
    period = np.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.a * jnp.sin(2 * t) - x[0] - self.k * side])

    def switching(self, t, x):
        return x[0]


@pytest.mark.parametrize("options", [{}, {"segments": 2, "steps": 200}])
@pytest.mark.slow
def test_a_crossing_at_the_start_counts_once(options):
    """Half a period turns the state by π/2, and a crossing with the speed v multiplies the
    derivative by [[1, 0], [−s, 1]], s = 2k/v: the trace is s² − 2."""
    a, k = jnp.linspace(0.7, 1.6, 60), 0.5
    speed = 2 * a / 3 + k

    def found(a, speed):
        guess = jnp.stack([0.0, -0.97 * speed])
        return jf.periodic_orbit(Relay(a, k), guess, throw=False, **options)

    orbits = eqx.filter_vmap(found)(a, speed)
    assert_allclose(orbits.x0, np.stack([0 * a, -speed], axis=1), rtol=0, atol=1e-9)
    assert_array_equal(orbits.num_events, 2)
    traces = np.trace(orbits.monodromy, axis1=1, axis2=2)
    assert_allclose(traces, (2 * k / speed) ** 2 - 2, rtol=0, atol=1e-7)
