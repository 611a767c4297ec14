"""Random systems with relays, and random changes of all numbers of a problem.

A seed enters; the numbers of a system, which `relay_motion` moves exactly and `RelaySystem` as the
package does, and a direction in the space of these numbers and initial states leave.
"""

import jax
import numpy as np

import jaxfil as jf
from tests.oracles.relay_modes import Relays
from tests.oracles.wall_motion import Walls


class RelaySystem(jf.System):
    """x' = A x + b + Σ_j side_j (c_j + g_j H_j), H = N x - d."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    g: jax.Array
    n: jax.Array
    d: jax.Array

    def vector_field(self, t, x, side):
        relays = self.c + self.g * self.switching(t, x)[:, None]
        return self.a @ x + self.b + side @ relays

    def switching(self, t, x):
        return self.n @ x - self.d


def random_system(seed, m, n=3):
    """A system of order one that turns, with surfaces near its state and mostly attracting."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a = 1.5 * (a - a.T) + 0.4 * rng.normal(size=(n, n)) - 0.3 * np.eye(n)
    normals, c = rng.normal(size=(m, n)), 1.5 * rng.normal(size=(m, n))
    attracts = rng.random(m) < 0.8
    c = np.where((attracts & ((normals * c).sum(axis=1) > 0))[:, None], -c, c)
    g = rng.normal(size=(m, n)) * (rng.random((m, 1)) < 0.5)
    d = 0.5 * rng.normal(size=m)
    return Relays(a, rng.normal(size=n), c, g, normals, d), rng.normal(size=n)


def random_direction(system, x0, seed):
    """A change of everything, of order one; what is zero of a system with walls stays so: that
    coordinates change by their velocities alone, and that a wall throws nothing back."""
    rng = np.random.default_rng([seed, 1])
    by = [rng.normal(size=np.shape(v)) for v in system]
    if isinstance(system, Walls):
        by = [np.where(np.asarray(v) == 0, 0.0, u) for u, v in zip(by, system, strict=True)]
    return type(system)(*by), rng.normal(size=x0.shape)
