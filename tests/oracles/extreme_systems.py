"""Systems with answers in closed form, for parameters far outside the usual.

Parameters enter, systems leave."""

import jax
import jax.numpy as jnp

import jaxfil as jf


class Scaled(jf.System):
    """x'' = −x − F sgn x' in other units of time and state."""

    friction: jax.Array
    time: jax.Array
    state: jax.Array

    def vector_field(self, t, x, side):
        speed = -x[0] - self.friction * self.state * side
        return jnp.stack([x[1], speed]) / self.time

    def switching(self, t, x):
        return x[1]


class Circle(jf.System):
    """Round the origin below the line x₂ = 1 + gap, round (−1, 0) above it."""

    gap: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([-x[1], x[0] + 0.5 * (1 - side)])

    def switching(self, t, x):
        return 1 + self.gap - x[1]


class Spring(jf.System):
    """x'' = −A sgn x: parabolas."""

    pull: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.pull * side])

    def switching(self, t, x):
        return x[0]


class Comb(jf.System):
    """x' = sgn sin kt: a surface that no state has a say in."""

    k: jax.Array

    def vector_field(self, t, x, side):
        return side[None] + 0 * x

    def switching(self, t, x):
        return jnp.sin(self.k * t)


class Turn(jf.systems.CoulombOscillator):
    """x'' = −x with a surface that changes nothing, seen twice a turn."""

    @property
    def period(self):
        return 2 * jnp.pi


class Ring(jf.System):
    """Slides round |x| = radius for ever, once in 2π."""

    radius: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([-x[1] - side * x[0], x[0] - side * x[1]])

    def switching(self, t, x):
        return x[0] ** 2 + x[1] ** 2 - self.radius**2

    @property
    def period(self):
        return 2 * jnp.pi


class Parabolas(Spring):
    """The same, seen once in two flights from (0, 1): every method of order two is exact."""

    @property
    def period(self):
        return 4 / self.pull
