"""Derivatives of the end, and of the times of contacts and the states there, by everything at once.

A number of systems and a seed enter; a group of verdicts for each kind of system leaves. Systems
are those of `relays` and `walls`. Derivatives along random directions in the space of all
parameters and initial states, by forward mode, are compared with central differences of the exact
motion in extended precision.
"""

import equinox as eqx
import jax
import numpy as np

import jaxfil as jf
from benchmarks.reliability import comparison, relays, walls
from benchmarks.reliability.comparison import Lane, counted, structure, values
from benchmarks.reliability.lanes import counts, in_chunks
from benchmarks.reliability.verdict import DECIDED, Group, Verdict
from jaxfil.model.outcomes import outcome_names
from tests.oracles.random_problems import RelaySystem, random_direction

# Errors allowed, relative to the largest derivative and the size of the motion.
ALLOWED = 1e-7
STEP = 1e-9
# Kind, states or coordinates, surfaces or walls, and their part of all systems.
SHAPES = {
    ("relays", 3, 1): 0.015,
    ("relays", 3, 2): 0.015,
    ("walls", 1, 1): 0.01,
    ("walls", 2, 2): 0.01,
}


def solver(kind):
    """Solutions of a chunk and their derivatives along directions."""
    make, t1, room = (
        (RelaySystem, relays.T1, relays.ROOM)
        if kind == "relays"
        else (walls.WallSystem, walls.T1, walls.ROOM)
    )

    def solved(system, x0, dt):
        sol = jf.solve(make(*system), x0, 0.0, t1, dt, max_events=room, throw=False)
        rest = sol.result, sol.t_final, sol.x_final, sol.mode_final, sol.num_events, sol.events
        return (sol.x_final, sol.events.ts, sol.events.xs), rest

    @eqx.filter_jit
    @eqx.filter_vmap
    def solve(problem, direction, dt):
        function = lambda system, x0: solved(system, x0, dt)  # noqa: E731
        _, slopes, rest = jax.jvp(function, problem, direction, has_aux=True)
        return slopes, rest

    return solve


def problems_of(kind, n, m, count, seed):
    """(problems, exact motions, steps), the motions successful and decided ones."""
    module, found = (relays, []) if kind == "relays" else (walls, [])
    for i in range(count):
        shape = (m, n) if kind == "relays" else (n, m)
        problem = module.random_system([seed, n, m, i], *shape)
        motion = module.exact(*problem)
        fast = motion.rate > module.RESOLVED / 2e-4
        if motion.outcome == "successful" and motion.margin >= DECIDED and not fast:
            found.append((i, problem, motion, min(0.025, module.RESOLVED / motion.rate)))
    return found


def difference(exact, problem, direction):
    """d/dstep of what is compared; None if the step changes the contacts."""
    ahead, behind = (comparison.moved(exact, problem, direction, s) for s in (STEP, -STEP))
    if structure(ahead) != structure(behind):
        return None
    pairs = zip(values(ahead), values(behind), strict=True)
    return [((u - v) / (2 * np.longdouble(STEP))).astype(float) for u, v in pairs]


def judge(number, exact, problem, direction, motion, slopes, lane: Lane):
    """The verdict on the derivatives of one solution."""
    if lane.outcome != "successful":
        return Verdict(number, "refused", lane.outcome)
    want, error = difference(exact, problem, direction), comparison.distance(motion, lane)
    if want is None:
        return Verdict(number, "rounding", "contacts change with a step of 1e-9")
    if error == np.inf:
        return Verdict(number, "wrong", "other contacts")
    count = int(lane.count)
    kept = counted(lane.events.ts[:count], motion)
    got = slopes[0], slopes[1][:count][kept], slopes[2][:count][kept]
    size = 1 + np.abs(np.asarray(motion.x, float)).max()
    largest = 1 + max(abs(v).max(initial=0) for v in want)
    error = max(abs(u - v).max(initial=0) for u, v in zip(got, want, strict=True))
    error /= largest * size
    kind = "right" if error <= ALLOWED else "wrong"
    detail = f"error {error:.1e} of derivatives up to {largest:.0e}, margin {motion.margin:.0e}"
    return Verdict(number, kind, detail, error)


def group(kind, n, m, count, seed):
    """The verdicts on the decided ones of `count` systems."""
    exact = (relays if kind == "relays" else walls).exact
    found = problems_of(kind, n, m, count, seed)
    directions = [random_direction(*problem, i) for i, problem, *_ in found]
    inputs = [(p, d) for (_, p, *_), d in zip(found, directions, strict=True)]
    slopes, rest = in_chunks(solver(kind), inputs, np.asarray([dt for *_, dt in found]))
    names, verdicts = outcome_names(rest[0]), []
    for k, (i, problem, motion, _) in enumerate(found):
        slope, lane = jax.tree.map(lambda v, k=k: v[k], (slopes, rest[1:]))
        lane = Lane(str(names[k]), *lane)
        verdicts.append(judge(i, exact, problem, directions[k], motion, slope, lane))
    nouns = ("state", "surface") if kind == "relays" else ("coordinate", "wall")
    sizes = [f"{k} {noun}{'s' * (k > 1)}" for k, noun in zip((n, m), nouns, strict=True)]
    return Group("derivatives", ", ".join([kind, *sizes]), verdicts)


def groups(systems, seed):
    """All kinds of systems."""
    for (kind, n, m), count in counts(SHAPES, systems).items():
        yield group(kind, n, m, count, seed)
