"""Systems that are stiff on one side of a surface, which tests and benchmarks run.

Stiffnesses enter, as leaves; a system leaves.
"""

import jax
import jax.numpy as jnp

import jaxfil as jf

FRICTION = 0.4


class DampedRelay(jf.System):
    """x'' = 2 cos 1.3t − x − F sgn w − d max(w, 0), w = x' − v: a contact damped on one side."""

    damping: jax.Array
    v: jax.Array

    def vector_field(self, t, x, side):
        w = x[1] - self.v
        damper = 0.5 * (1 + side) * self.damping * w
        return jnp.stack([x[1], 2 * jnp.cos(1.3 * t) - x[0] - FRICTION * side - damper])

    def switching(self, t, x):
        return x[1] - self.v


class SoftFloor(jf.System):
    """y'' = −1 above a floor, −1 − ky − cy' in it."""

    k: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        inside = 0.5 * (1 - side)
        return jnp.stack([x[1], -1 - inside * (self.k * x[0] + self.c * x[1])])

    def switching(self, t, x):
        return x[0]
