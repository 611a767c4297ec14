"""Systems of `cases`: parameters enter, systems with motions in closed form leave."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxfil as jf


class Resetting(jf.System):
    """A field, surfaces and a reset, each a function that needs no side."""

    field: Callable = eqx.field(static=True)
    surfaces: Callable = eqx.field(static=True)
    jump: Callable = eqx.field(static=True)

    def vector_field(self, t, x, side):
        return self.field(t, x)

    def switching(self, t, x):
        return self.surfaces(t, x)

    def reset(self, t, x, surface):
        return self.jump(t, x, surface)


class Switched(jf.System):
    """A field of the sides, and surfaces; parameters `p`."""

    field: Callable = eqx.field(static=True)
    surfaces: Callable = eqx.field(static=True)
    p: jax.Array | None = None

    def vector_field(self, t, x, side):
        return self.field(t, x, side, self.p)

    def switching(self, t, x):
        return self.surfaces(t, x)


def relays(matrix):
    """x' = M sgn x."""
    return Switched(lambda t, x, side, p: p @ side, lambda t, x: x, jnp.asarray(matrix))


def spiral(k):
    """x' = -sgn x + k sgn y, y' = -k sgn x - sgn y: legs shrink by (k - 1)/(k + 1)."""
    return relays([[-1.0, k], [-k, -1.0]])


TWISTING = Switched(
    lambda t, x, side, p: jnp.stack([x[1], -10.0 * side[0] - 3.0 * side[1]]), lambda t, x: x
)

TURNING_CORNER = Switched(
    lambda t, x, side, p: jnp.stack([t * side[1] - side[0], t * side[0] - side[1]]),
    lambda t, x: x,
)

TWO_FOLD = Switched(
    lambda t, x, side, p: jnp.where(
        side > 0, jnp.stack([-x[1], 1.0 + 0 * t, p]), jnp.stack([x[2], p, 1.0 + 0 * t])
    ),
    lambda t, x: x[0],
    jnp.asarray(-2.0),
)

FOLD = Switched(
    lambda t, x, side, p: jnp.stack([jnp.ones_like(t), jnp.where(side > 0, x[0] - 1, 1.0)]),
    lambda t, x: x[1],
)

PULLED_BLOCK = Switched(
    lambda t, x, side, p: jnp.stack([x[1], -0.5 * (x[0] - 0.2 * t) - 0.3 * side]),
    lambda t, x: x[1],
)

DECAY = Switched(lambda t, x, side, p: -x - 0.15 * (1 - side), lambda t, x: x[0] - 0.5)


class Ramp(jf.System):
    """x' = 1 - x while a ramp is above x, -x below."""

    def vector_field(self, t, x, side):
        return 0.5 * (1 + side) - x

    def switching(self, t, x):
        return jnp.mod(t, 1.0) - x[0]


class CrossedRamp(Ramp):
    """The same, said only to be crossed."""

    slides = False


def passing(a):
    """x1' = 1, x2' = side0 + 10 side1: one surface at x1 = a, another one at t = 1/2."""
    return Switched(
        lambda t, x, side, p: jnp.stack([jnp.ones_like(t), side[0] + 10 * side[1]]),
        lambda t, x: jnp.stack([x[0] - a, t - 0.5]),
    )


def blend(rows):
    """The first two states are slid on; the weights are the rates of the others. `rows` are the
    rates at sides ++, +-, -+, -- at t = 0 and from t = 1 on."""

    def field(t, x, side, p):
        table = p[0] + (p[1] - p[0]) * jnp.clip(t, 0.0, 1.0)
        u, v = (1 + side) / 2
        shares = jnp.stack([u * v, u * (1 - v), (1 - u) * v, (1 - u) * (1 - v)])
        return jnp.concatenate([shares @ table, side])

    return Switched(field, lambda t, x: x[:2], jnp.asarray(rows))


KICK = Resetting(
    lambda t, x: jnp.stack([x[1], -x[0]]), lambda t, x: t - 1.0, lambda t, x, s: x.at[1].add(0.7)
)

INJECTION = Resetting(lambda t, x: -x, lambda t, x: t - 1.0, lambda t, x, s: x + 2.0)

TOGGLE = Resetting(
    lambda t, x: jnp.stack([x[1], -x[0], 0 * t]),
    lambda t, x: x[0],
    lambda t, x, s: x.at[2].multiply(-1.0),
)

CORNER = Resetting(
    lambda t, x: jnp.stack([x[2], x[3], 0 * t, 0 * t]),
    lambda t, x: x[:2],
    lambda t, x, s: jnp.where(s == 0, x.at[2].multiply(-0.5), x.at[3].multiply(-1.0)),
)

BALL_AND_BEAD = Resetting(
    lambda t, x: jnp.stack([x[1], -10.0 + 0 * t, x[3], 0 * t]),
    lambda t, x: jnp.stack([x[0], 1 - x[2]]),
    lambda t, x, s: jnp.where(s == 0, x.at[1].multiply(-0.9), x.at[3].multiply(-1.0)),
)


def cradle_reset(t, x, s):
    """Balls s and s + 1 of equal mass exchange their speeds."""
    v = x[4:]
    dv = v[s + 1] - v[s]
    return jnp.concatenate([x[:4], v.at[s].add(dv).at[s + 1].add(-dv)])


CRADLE = Resetting(
    lambda t, x: jnp.concatenate([x[4:], jnp.zeros(4)]),
    lambda t, x: x[1:4] - x[:3],
    cradle_reset,
)


class Rocking(jf.System):
    """θ'' = -sgn θ; θ' → 0.9 θ' as θ passes 0."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -side])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], 0.9 * x[1]])


class Shaking(jf.System):
    """A ball under g = 1 on a table at a sin t, restitution 1/2."""

    a: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.full((), -1.0)])

    def switching(self, t, x):
        return x[0] - self.a * jnp.sin(t)

    def reset(self, t, x, surface):
        v = self.a * jnp.cos(t)
        return jnp.stack([x[0], v - 0.5 * (x[1] - v)])
