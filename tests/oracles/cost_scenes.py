"""One oscillator with more and more declared: the rungs of the ladder of costs.

A frequency and a place enter; systems leave.

x'' = cos ωt − 0.1x' − x; a belt of speed g that rubs on the mass; a place, x = ±g, where the force
changes or where a wall is. With g = `FAR` all of them are out of reach, and what a scene takes is
what declaring them costs.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

import jaxfil as jf

# Far beyond what the oscillator reaches.
FAR = 1e3


class Smooth(jf.System):
    """No surface."""

    omega: jax.Array
    place: jax.Array

    def drive(self, t, x):
        """Force of the drive, the damper and the spring."""
        return jnp.cos(self.omega * t) - 0.1 * x[1] - x[0]

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.drive(t, x)])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Crossing(Smooth):
    """A spring whose force changes at x = g: crossed, never slid on."""

    slides: ClassVar[bool] = False

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.drive(t, x) - 0.3 * side])

    def switching(self, t, x):
        return x[0] - self.place


class Sliding(Smooth):
    """A belt of speed g that the mass sticks to."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.drive(t, x) - 0.6 * side])

    def switching(self, t, x):
        return x[1] - self.place


class Impacts(Smooth):
    """A wall at x = g."""

    slides: ClassVar[bool] = False

    def switching(self, t, x):
        return self.place - x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.8 * x[1]])


class BeltAndWall(Smooth):
    """The belt and a wall that it carries the mass away from: no side of one is the other's."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.drive(t, x) - 0.6 * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[1] - self.place, x[0] + self.place])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(surface == 1, -0.3, 1.0) * x[1]])


class General(BeltAndWall):
    """The same with a force of the wall's side: each surface sees the other's, so that sliding on
    both at once is Newton's method on four fields."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.drive(t, x) - 0.6 * side[0] - 0.3 * side[1]])
