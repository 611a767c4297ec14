"""Random relay systems against their exact motions (`relay_motion`).

A number of systems and a seed enter; a group of verdicts for each pair of n states and m surfaces
leaves. Compared are the outcome, the kinds, surfaces and times of all contacts, the states there,
and the state and mode at the end.
"""

import equinox as eqx
import numpy as np

import jaxfil as jf
from benchmarks.reliability import comparison
from benchmarks.reliability.lanes import counts, in_chunks
from benchmarks.reliability.verdict import Group
from tests.oracles.random_problems import RelaySystem, random_system
from tests.oracles.relay_motion import propagate

T1 = 4.0
# Contacts that a solution keeps, and that an exact motion may have.
ROOM, MOST = 256, 2000
# Steps resolve the fastest field on the way, sliding fields among them: this much of its norm.
RESOLVED, LONGEST, SHORTEST = 0.3, 0.025, 2e-5
# (n, m) and their part of all systems; three surfaces on which all may slide compile for minutes.
SHAPES = {
    **{(n, 1): 0.1 for n in (2, 3, 4, 5, 6)},
    **{(n, 2): 0.095 for n in (2, 3, 4, 5, 6)},
    (3, 3): 0.025,
}


@eqx.filter_jit
@eqx.filter_vmap
def solve(system, x0, dt):
    """What is compared of a chunk of solutions."""
    sol = jf.solve(RelaySystem(*system), x0, 0.0, T1, dt, max_events=ROOM, throw=False)
    return comparison.compared(sol)


def exact(system, x0):
    """The motion."""
    return propagate(system, x0, T1, MOST, through=True)


def group(n, m, count, seed):
    """The verdicts on `count` systems of n states and m surfaces."""
    problems = [random_system([seed, n, m, i], m, n) for i in range(count)]
    motions = [exact(*problem) for problem in problems]
    dts = np.clip([RESOLVED / (motion.rate + 1e-3) for motion in motions], SHORTEST, LONGEST)
    sols = in_chunks(solve, problems, dts)
    verdicts = comparison.verdicts(exact, problems, motions, sols, ROOM)
    return Group("relays", f"{n} states, {m} surface{'s' * (m > 1)}", verdicts)


def groups(systems, seed):
    """All shapes."""
    for (n, m), count in counts(SHAPES, systems).items():
        yield group(n, m, count, seed)
