"""Planar systems whose equilibria are known in closed form."""

import jax
import jax.numpy as jnp

import jaxfil as jf


class Boundary(jf.System):
    """F_+ = (−x, μ − y), F_− = (c, g), H = y: a regular equilibrium (0, μ) on side +, and a
    pseudo-equilibrium x = −cμ/g, w = (g + μ)/(g − μ), with the eigenvalue −g/(g − μ) of the slide.
    Both are one at μ = 0: persistence for g > 0, a nonsmooth fold for g < 0."""

    mu: jax.Array
    g: jax.Array
    c: jax.Array = 0.75

    def vector_field(self, t, x, side):
        above = jnp.stack([-x[0], self.mu - x[1]])
        below = jnp.stack([self.c + 0 * x[0], self.g])
        return jnp.where(side > 0, above, below)

    def switching(self, t, x):
        return x[1]


class Circle(jf.System):
    """F_+ = −k (x, y), F_− = (1, 0), H = x² + y² − 1: pseudo-equilibria (±1, 0) with
    w = (1 ∓ k)/(1 ± k), of which (−1, 0) is virtual; the eigenvalue at (1, 0) is −k/(1 + k)."""

    k: jax.Array

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, -self.k * x, jnp.array([1.0, 0.0]))

    def switching(self, t, x):
        return x[0] ** 2 + x[1] ** 2 - 1


class PseudoSaddleNode(jf.System):
    """F_+ = (μ − x², −1), F_− = (b, 1), H = y: pseudo-equilibria x = ±√(μ + b), w = 0, with the
    eigenvalue −x of the slide, and a fold at μ = −b."""

    mu: jax.Array
    b: jax.Array

    def vector_field(self, t, x, side):
        one = jnp.ones_like(x[0])
        above = jnp.stack([self.mu - x[0] ** 2, -one])
        return jnp.where(side > 0, above, jnp.stack([self.b * one, one]))

    def switching(self, t, x):
        return x[1]


class TwoSurfaces(jf.System):
    """ẋ = a − x − sgn x + 2 sgn y, ẏ = −y − 2 sgn x − sgn y: a pseudo-equilibrium at the origin
    with weights (a, −2a)/5 up to a = 5/2, then one on x = 0 alone, w = a − 2, y = 5 − 2a, up to
    a = 3, and then a regular one, x = a − 3, y = −1."""

    a: jax.Array

    def vector_field(self, t, x, side):
        first = self.a - x[0] - side[0] + 2 * side[1]
        return jnp.stack([first, -x[1] - 2 * side[0] - side[1]])

    def switching(self, t, x):
        return x


class Relays(jf.System):
    """ẋ = B sgn x, with H = unit · x: a pseudo-equilibrium at the origin with the weights 0."""

    b: jax.Array
    unit: jax.Array

    def vector_field(self, t, x, side):
        return self.b @ side

    def switching(self, t, x):
        return self.unit * x


class Spring(jf.System):
    """x″ = f − x − x′/2 before a wall at x = 0: at rest at x = f > 0, and on the wall for f < 0,
    with the reaction −f."""

    f: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], self.f - x[0] - 0.5 * x[1]])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -0.5 * x[1]])


class Oscillator(jf.System):
    """The normal form of a Hopf bifurcation at a = 0 round (0, 1), of radius √a, and a surface."""

    a: jax.Array

    def vector_field(self, t, x, side):
        y = x - jnp.array([0.0, 1.0])
        return (self.a - y @ y) * y + 2.0 * jnp.stack([-y[1], y[0]]) - 0.0 * side

    def switching(self, t, x):
        return x[1]


class SoftStop(jf.System):
    """x″ = f − x − 0.3 x′, less k (x − 1) where x > 1."""

    f: jax.Array
    k: jax.Array

    def vector_field(self, t, x, side):
        stop = jnp.where(side > 0, self.k * (x[0] - 1), 0.0)
        return jnp.stack([x[1], self.f - x[0] - 0.3 * x[1] - stop])

    def switching(self, t, x):
        return x[0] - 1


class Hill(jf.System):
    """A particle above y = −h x², which throws it back; it comes to rest on the top for μ < 0."""

    mu: jax.Array
    k: jax.Array
    h: jax.Array

    def vector_field(self, t, x, side):
        return jnp.stack([x[2], x[3], -self.k * x[0] - x[2], self.mu - x[1] - x[3]])

    def switching(self, t, x):
        return x[1] + self.h * x[0] ** 2

    def reset(self, t, x, surface):
        n = jnp.stack([2 * self.h * x[0], jnp.ones_like(x[0])])
        return jnp.concatenate([x[:2], x[2:] - 1.5 * (n @ x[2:]) / (n @ n) * n])
