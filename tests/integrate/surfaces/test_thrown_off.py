"""A mass at rest that something else throws off its floor, while a friction turns round.

The mass (y, w) is pressed on its floor by 1. Another one, (x, v), rubs with 1/2 and is thrown back
half as fast by the wall x = 1, or by a tick, which throws the first one up with a velocity of 1:
parabolas.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

RUB, UP, END = 0.5, 1.0, 1.5


class Lever(jf.System):
    """The impact throws the first mass up."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -RUB * side[0], x[3], -1.0])

    def switching(self, t, x):
        return jnp.stack([x[1], 1 - x[0], x[2]])

    def reset(self, t, x, surface):
        thrown = self.thrown(x)
        return jnp.where(surface == 1, thrown, jnp.where(surface == 2, x.at[3].multiply(-0.5), x))

    def thrown(self, x):
        return jnp.stack([x[0], -x[1] / 2, x[2], x[3] + UP])


class Struck(Lever):
    """A tick does; the wall is elsewhere."""

    def switching(self, t, x):
        return jnp.stack([x[1], 9 - x[0], x[2]])

    def tick(self, t, x, clock):
        return self.thrown(x)

    @property
    def clocks(self):
        return (jf.Clock(10.0, 0.75),)


@pytest.mark.release
@pytest.mark.parametrize(
    "system", [pytest.param(Lever(), marks=pytest.mark.release), Struck()], ids=["impact", "tick"]
)
def test_it_keeps_the_velocity_that_it_is_given(system):
    v0 = 1.5
    meets = (v0 - np.sqrt(v0**2 - 2 * RUB)) / RUB
    hit = 0.75 if isinstance(system, Struck) else meets
    v, s = v0 - RUB * hit, END - hit
    sol = jf.solve(system, jnp.array([0.0, v0, 0.0, 0.0]), 0.0, END, 0.2, compact=True)
    x = v0 * hit - RUB * hit**2 / 2
    want = [x - v / 2 * s + RUB * s**2 / 2, -v / 2 + RUB * s, UP * s - s**2 / 2, UP - s]
    np.testing.assert_allclose(sol.x_final, want, rtol=0, atol=1e-14)
