"""Several surfaces that are one place, such as brakes on one disc: their motion is unique, while
their weights are not. They share the load, and a slide ends when all are at their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.model.outcomes import outcome_names


class Brakes(jf.System):
    """A disc under a load 3 sin t with several brakes, each with H = c v of its own scale c."""

    limits: jax.Array
    scales: tuple = ()

    def vector_field(self, t, x, side):
        rubs = self.limits @ (side * jnp.sign(jnp.array(self.scales)))
        return jnp.stack([x[1], 3.0 * jnp.sin(t) - rubs])

    def switching(self, t, x):
        return jnp.array(self.scales) * x[1]


class Brake(jf.System):
    """The same with one brake."""

    limit: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], 3.0 * jnp.sin(t) - self.limit * side])

    def switching(self, t, x):
        return x[1]


_MORE = [
    pytest.param(s, marks=pytest.mark.release) for s in ((0.5, 1.0, -1.0), (1.0, -1.0, 2.0, 1.0))
]


@pytest.mark.release
@pytest.mark.parametrize("scales", [(1.0, -2.0), *_MORE])
def test_brakes_on_one_disc_are_one_brake(scales):
    def end(system):
        sol = jf.solve(system, jnp.zeros(2), 0.0, 9.0, 0.05, max_events=64, throw=False)
        return sol.x_final, sol.result, sol.events.ts[0]

    k = len(scales)
    totals = jnp.array([1.8, 2.2, 0.9])
    # A different share of the total for each lane.
    shares = jnp.stack([jnp.roll(jnp.arange(1.0, k + 1), i) for i in range(3)])
    limits = totals[:, None] * shares / jnp.sum(shares, axis=1, keepdims=True)

    def several(limits):
        return end(Brakes(limits, scales))

    one = jax.jit(jax.vmap(lambda limit: jax.jvp(lambda v: end(Brake(v))[0], (limit,), (1.0,))))
    exact, slope = one(totals)
    found, results, first = jax.jit(jax.vmap(several))(limits)
    assert (outcome_names(results) == "successful").all()
    np.testing.assert_allclose(first, np.arcsin(totals / 3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-11)
    # Each limit counts for itself, whatever its brake carries.
    by_limits = jax.jit(jax.vmap(jax.jacfwd(lambda v: several(v)[0])))(limits)
    np.testing.assert_allclose(by_limits, np.stack([slope] * k, axis=-1), rtol=0, atol=1e-9)
