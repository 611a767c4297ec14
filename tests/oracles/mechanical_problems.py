"""Random masses with dry friction and walls, as numbers and as a user's system.

A seed and a shape (masses, frictions, walls) enter; a `Machine`, which `mechanics` moves exactly
and `MechanicalSystem` as the package does, and an initial state leave.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from tests.oracles.contact_modes import Machine

T1 = 5.0
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


class MechanicalSystem(jf.System):
    """The masses of a `Machine`, whose leaves these are, but for the inverse of the mass matrix.
    Surfaces are the frictions' relative velocities, then the gaps of walls."""

    mobility: jax.Array
    stiffness: jax.Array
    damping: jax.Array
    constant: jax.Array
    load: jax.Array
    drive: jax.Array
    drift: jax.Array
    rubs: jax.Array
    limits: jax.Array
    falls: jax.Array
    belts: jax.Array
    walls: jax.Array
    places: jax.Array
    restitutions: jax.Array

    def vector_field(self, t, x, side):
        n, rubs = len(self.constant), len(self.limits)
        q, v, u = x[:n], x[n : 2 * n], x[2 * n :]
        friction = -self.limits * side[:rubs] + self.falls * self.velocities(t, v)
        force = self.constant + self.load @ u - self.stiffness @ q - self.damping @ v
        force = force + friction @ self.rubs
        return jnp.concatenate([v, self.mobility @ force, self.drive @ u + self.drift])

    def switching(self, t, x):
        n = len(self.constant)
        gaps = self.walls @ x[:n] - self.places
        return jnp.concatenate([self.velocities(t, x[n : 2 * n]), gaps])

    def velocities(self, t, v):
        return self.rubs @ v - self.belts[:, 0] - self.belts[:, 1] * t


class WalledSystem(MechanicalSystem):
    """The same with impacts on the walls."""

    def reset(self, t, x, surface):
        n, k = len(self.constant), surface - len(self.limits)
        normal = self.walls[k]
        direction = self.mobility @ normal
        push = (1 + self.restitutions[k]) * (normal @ x[n : 2 * n]) / (normal @ direction)
        return jnp.where(k >= 0, x.at[n : 2 * n].add(-push * direction), x)


def numbers_of(machine: Machine):
    """What `MechanicalSystem` is made of."""
    return np.linalg.inv(machine.mass), *machine[1:]


def system_of(numbers):
    """The system of these."""
    return (WalledSystem if len(numbers[-1]) else MechanicalSystem)(*numbers)


def random_machine(seed, masses, rubs, walls):
    """Masses of order one; frictions on the ground, on belts and between neighbours; walls below,
    above and between neighbours, of which some are touched at the start."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(masses, masses)))
    stiffness = turn.T @ np.diag(rng.uniform(0, 6.0, masses)) @ turn
    mass = np.diag(rng.uniform(0.5, 2.0, masses))
    if rng.random() < 0.3:
        mass = mass + 0.15 * np.ones((masses, masses))
    damping = rng.uniform(0, 0.3) * np.eye(masses) + 0.05 * rng.normal(size=(masses, masses))
    constant = np.where(rng.random(masses) < 0.7, -1, 1) * rng.uniform(0.2, 3, masses)
    load = rng.normal(size=(masses, 2)) * rng.choice([0.0, 1.0, 2.0])
    falls = np.where(rng.random(rubs) < 0.3, rng.uniform(0, 0.3, rubs), 0.0)
    moving = rng.random((rubs, 1)) < 0.4
    belts = np.where(moving, rng.normal(size=(rubs, 2)) * [0.7, 0.3], 0.0)
    belts[:, 1] *= rng.random(rubs) < 0.5
    e = np.where(rng.random(walls) < 0.3, 0.0, rng.uniform(0, 0.9, walls))
    limits = rng.uniform(0.1, 2.5, rubs)
    walled, places = _directions(rng, masses, walls), rng.integers(-24, 25, walls) / 32.0
    omega = rng.uniform(1, 6)
    numbers = (mass, stiffness, damping, constant, load, omega * TURN, np.zeros(2))
    frictions = (_directions(rng, masses, rubs), limits, falls, belts)
    machine = Machine(*numbers, *frictions, walled, places, e)
    return machine, _start(rng, machine)


def random_stopped(seed, masses, rubs, walls):
    """The same, with dead stops at zero, of which the first is beside a friction on its mass. There
    rounding in proportion to the position vanishes."""
    machine, _ = random_machine(seed, masses, rubs, walls)
    rubs = np.concatenate([machine.walls[:1], machine.rubs[1:]])
    nothing = np.zeros(walls)
    machine = machine._replace(rubs=rubs, places=nothing, restitutions=nothing)
    return machine, _start(np.random.default_rng(seed), machine)


def _directions(rng, masses, count):
    """Rows of one mass against the ground, or of two neighbours against each other, that are
    independent."""
    rows = np.zeros((count, masses))
    for j, i in enumerate(rng.permutation(masses)[:count]):
        rows[j, i] = 1.0 if rng.random() < 0.8 else -1.0
        if i and rng.random() < 0.5:
            rows[j, i - 1] = -rows[j, i]
    return rows


def _start(rng, machine: Machine):
    """A state on or above the walls; at rest on some of them, and on frictions, or not."""
    masses, rest = len(machine.mass), rng.random() < 0.4
    q, v, u = rng.normal(size=masses), rng.normal(size=masses), rng.normal(size=2)
    touches = rng.random(len(machine.walls)) < (0.7 if rest else 0.1)
    gaps = np.where(touches, 0, rng.integers(1, 64, len(touches)) / 32.0)
    q = np.round(q * 32) / 32
    q += (
        np.round(
            np.linalg.pinv(machine.walls) @ (gaps + machine.places - machine.walls @ q) * 2**20
        )
        / 2**20
    )
    if rest:
        v = np.zeros(masses)
        rows = machine.rubs[rng.random(len(machine.rubs)) < 0.3]
        v = v + (rng.normal(size=len(rows)) @ rows if len(rows) else 0)
        v[rng.random(masses) < 0.5] = 0.0
    return np.concatenate([q, v, u])
