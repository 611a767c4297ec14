"""Taylor steps where a root, or a power that is not whole, is made of a zero that stays zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf


class Reservoir(jf.System):
    """The level h of a tank with an outlet, and the demand that it does not meet while empty."""

    deficit: jax.Array

    def vector_field(self, t, x, side):
        falls = -0.6 * jnp.sqrt(jnp.maximum(x[0], 0.0)) - self.deficit
        filled = jnp.stack([falls, 0 * t])
        return jnp.where(side > 0, filled, jnp.stack([0.2 + 0 * t, self.deficit + 0.2]))

    def switching(self, t, x):
        return x[0]


@pytest.mark.slow
def test_a_tank_that_has_run_empty():
    @jax.jit
    def end(deficit):
        step, x0 = jf.Adaptive(1e-9, 1e-12), jnp.array([0.3, 0.0])

        def run(deficit):
            sol = jf.solve(Reservoir(deficit), x0, 0.0, 3.0, step, stepper=jf.Taylor())
            return sol.x_final, sol.x_final

        return jax.jacfwd(run, has_aux=True)(deficit)

    slope, found = end(jnp.array(0.3))
    # With r = √h, dt = −2 r dr/(0.6 r + e) from r0 to 0.
    e, r0 = 0.3, np.sqrt(0.3)
    log = np.log(1 + 0.6 * r0 / e)
    empty = 2 / 0.6 * (r0 - e / 0.6 * log)
    sooner = 2 / 0.36 * (0.6 * r0 / (e + 0.6 * r0) - log)
    assert_allclose(found, [0.0, e * (3 - empty)], rtol=0, atol=1e-8)
    # The last step to the surface is of order 3/2 in its derivatives.
    assert_allclose(slope, [0.0, 3 - empty - e * sooner], rtol=0, atol=1e-3)


class Belt(jf.System):
    """A mass on a belt, with a friction that falls with a power of the speed of slip."""

    power: jax.Array

    def vector_field(self, t, x, side):
        slip = abs(x[1] - 0.2) / 0.1
        return jnp.stack([x[1], -x[0] - (0.4 + 0.6 * jnp.exp(-(slip**self.power))) * side])

    def switching(self, t, x):
        return x[1] - 0.2


@pytest.mark.slow
def test_a_mass_that_sticks_by_a_friction_with_a_power():
    def end(x, power):
        x0 = jnp.stack([x, 0.2])
        return jf.solve(Belt(power), x0, 0.0, 3.0, 0.05, stepper=jf.Taylor()).x_final

    @jax.jit
    @jax.vmap
    def both(power):
        return end(-0.5, power), jax.jacfwd(end, (0, 1))(-0.5, power)

    found, (by_x, by_power) = both(jnp.array([1.5, 2.0, 2.5]))
    assert_allclose(found, [[0.1, 0.2]] * 3, rtol=0, atol=1e-14)
    assert_allclose(by_x, [[1.0, 0.0]] * 3, rtol=0, atol=1e-14)
    assert_allclose(by_power, np.zeros((3, 2)), rtol=0, atol=1e-14)
