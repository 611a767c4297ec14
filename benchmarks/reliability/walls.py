"""Random linear mechanical systems with walls: impacts, rests, lift-offs (`wall_motion`).

A number of systems and a seed enter; a group of verdicts for each number of coordinates and walls
leaves. A harmonic load is carried as two more states.
"""

import equinox as eqx
import jax
import numpy as np

import jaxfil as jf
from benchmarks.reliability import comparison
from benchmarks.reliability.lanes import counts, in_chunks
from benchmarks.reliability.verdict import Group
from tests.oracles.wall_motion import Walls, propagate

T1 = 6.0
ROOM, MOST = 512, 2000
RESOLVED = 0.3
# (coordinates, walls) and their part of all systems.
SHAPES = {(1, 1): 0.07, (2, 1): 0.05, (2, 2): 0.05, (3, 2): 0.03}


class WallSystem(jf.System):
    """x' = a x + b, x = (q, v, load); the first coordinates are bounded from below."""

    a: jax.Array
    b: jax.Array
    d: jax.Array
    e: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return self.a @ x + self.b

    def switching(self, t, x):
        return x[: len(self.d)] - self.d

    def reset(self, t, x, surface):
        return x.at[(len(x) - 2) // 2 + surface].multiply(-self.e[surface])


def random_system(seed, dof, m):
    """A damped oscillator of order one, mostly pressed against its walls, with a harmonic load."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(dof, dof)))
    stiffness = turn.T @ np.diag(rng.uniform(0.2, 9.0, dof)) @ turn
    damping = 0.2 * rng.normal(size=(dof, dof)) + rng.uniform(0, 0.4) * np.eye(dof)
    a, b = np.zeros((2 * dof + 2,) * 2), np.zeros(2 * dof + 2)
    a[:dof, dof:-2] = np.eye(dof)
    a[dof:-2] = np.hstack([-stiffness, -damping, 2 * rng.normal(size=(dof, 2))])
    a[-2, -1], a[-1, -2] = (s * rng.uniform(1, 6) for s in (1, -1))
    b[dof:-2] = np.where(rng.random(dof) < 0.8, -1, 1) * rng.uniform(0.2, 4, dof)
    e = np.where(rng.random(m) < 0.1, 0.0, rng.uniform(0, 0.9, m))
    d, x0 = 0.5 * rng.normal(size=m), rng.normal(size=2 * dof + 2)
    x0[:m] = d + abs(0.7 * rng.normal(size=m))
    return Walls(a, b, d, e), x0


@eqx.filter_jit
@eqx.filter_vmap
def solve(system, x0, dt):
    """What is compared of a chunk of solutions."""
    sol = jf.solve(WallSystem(*system), x0, 0.0, T1, dt, max_events=ROOM, throw=False)
    return comparison.compared(sol)


def exact(system, x0):
    """The motion."""
    return propagate(system, x0, (len(x0) - 2) // 2, T1, MOST)


def group(dof, m, count, seed):
    """The verdicts on `count` systems."""
    problems = [random_system([seed, dof, m, i], dof, m) for i in range(count)]
    motions = [exact(*problem) for problem in problems]
    dts = np.asarray([RESOLVED / motion.rate for motion in motions])
    sols = in_chunks(solve, problems, dts)
    verdicts = comparison.verdicts(exact, problems, motions, sols, ROOM)
    what = f"{dof} coordinate{'s' * (dof > 1)}, {m} wall{'s' * (m > 1)}"
    return Group("impacts", what, verdicts)


def groups(systems, seed):
    """All shapes."""
    for (dof, m), count in counts(SHAPES, systems).items():
        yield group(dof, m, count, seed)
