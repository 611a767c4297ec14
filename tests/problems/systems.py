"""Small systems whose motions are worked out by hand.

Numbers enter; modules leave. A field that is affine on each side of a line, or constant in each
quadrant of two, has contacts, slides and corners at times that are fractions.
"""

import math

import jax
import jax.numpy as jnp

import jaxfil as jf

ZERO = ((0, 0), (0, 0))
AXES = ((1, 0), (0, 1))
# The second component for both surfaces of a `Corner`.
LEVELS = ((0, 1), (0, 1))


class Affine(jf.System):
    """x' = a + B x with its own a and B on each side of the line n·x = c."""

    a: jax.Array
    b: jax.Array
    n: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        fields = self.a + self.b @ x
        return jnp.where(side > 0, fields[0], fields[1])

    def switching(self, t, x):
        return self.n @ x - self.c


class NeverSliding(Affine):
    """The same, declared never to slide."""

    slides = False


class Corner(jf.System):
    """A constant field in each of the four quadrants of two lines."""

    table: jax.Array
    n: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        rows = jnp.where(side[0] > 0, self.table[0], self.table[1])
        return jnp.where(side[1] > 0, rows[0], rows[1])

    def switching(self, t, x):
        return self.n @ x - self.c


class Roots(jf.System):
    """A clock, a counter of its sides, and H with the given roots in the clock or in time."""

    roots: jax.Array
    timed: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([jnp.ones_like(t), side])

    def switching(self, t, x):
        return jnp.prod(jnp.where(self.timed > 0, t, x[0]) - self.roots)


class Box(jf.System):
    """Two surfaces, held one after the other; the product of both sides enters the third rate."""

    p: jax.Array
    q: jax.Array

    def vector_field(self, t, x, side):
        s1, s2 = side
        return jnp.stack([self.p - 2 * s1, self.q * s1 - 2 * s2, s1 + 2 * s2 + s1 * s2])

    def switching(self, t, x):
        return x[:2]


class Leave(jf.System):
    """Held at y = 0 by a force that grows as t, until it exceeds the friction; x' = side."""

    friction: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([side, t - self.friction * side])

    def switching(self, t, x):
        return x[1]


def affine(plus, minus, b_plus=ZERO, b_minus=ZERO, n=(0, 1), c=0, kind=Affine):
    """An `Affine` system, by default glued along y = 0."""
    return kind(*(jnp.asarray(v, float) for v in ((plus, minus), (b_plus, b_minus), n, c)))


def corner(field, n=AXES, c=(0, 0)):
    """A `Corner` system from a function of the two sides, by default with the axes as surfaces."""
    table = [[field(s1, s2) for s2 in (1, -1)] for s1 in (1, -1)]
    return Corner(*(jnp.asarray(v, float) for v in (table, n, c)))


def roots(times, timed=0.0):
    """A `Roots` system that crosses at these values of its clock, or at these times."""
    return Roots(jnp.asarray(times), jnp.asarray(float(timed)))


def belt(omega, gamma1=10.0, gamma2=0.0):
    """Belt friction, case 1 of Santhosh et al.: a linear spring."""
    return jf.systems.BeltFriction(gamma1=gamma1, gamma2=gamma2, omega=omega)


def cubic_belt(omega):
    """Belt friction, case 2: a cubic spring."""
    return belt(omega, 0.0, 10000.0)


class UnitBelt(jf.System):
    """A mass on a belt of speed 1: x'' = -x - F sgn(x' - 1)."""

    force: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - self.force * side])

    def switching(self, t, x):
        return x[1] - 1


class Turn(jf.System):
    """A point that goes round the unit circle, where y < 0 at a rate of its own."""

    rate: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, 1.0, self.rate) * jnp.stack([-x[1], x[0]])

    def switching(self, t, x):
        return x[1]


class ShakenTable(jf.System):
    """A ball on a table that moves as a sin t, under unit gravity, with a restitution."""

    a: jax.Array
    restitution: float
    slides = False
    period = 2 * jnp.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0] - self.a * jnp.sin(t)

    def reset(self, t, x, surface):
        table = self.a * jnp.cos(t)
        return jnp.stack([x[0], table - self.restitution * (x[1] - table)])


class Guided(jf.System):
    """s' = cos t / 2 − 0.3 s, and a part that is pressed by gravity on a wall at s²/2."""

    e: jax.Array
    slides = False
    period = 2 * math.pi

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t), 0.5 * jnp.cos(t) - 0.3 * x[2]])

    def switching(self, t, x):
        return x[0] - 0.5 * x[2] ** 2

    def reset(self, t, x, surface):
        rise = x[2] * (0.5 * jnp.cos(t) - 0.3 * x[2])
        return jnp.stack([x[0], rise - self.e * (x[1] - rise), x[2]])
